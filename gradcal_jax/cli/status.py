"""Exit statuses of commands."""

from typing import Final

DONE: Final = 0
NOT_AS_WISHED: Final = 1
"""Done, but a target is missed, a search has not converged, data contradict their model."""
WRONG_INPUT: Final = 2
FAILED: Final = 3
"""A device or a run failed."""
INTERRUPTED: Final = 130
BROKEN_PIPE: Final = 141
"""The reader closed the pipe before the end of the output (as a shell counts a SIGPIPE)."""
