"""The `gradcal` command. Slow imports happen only in the commands that need them.

Exit statuses: 0 done, 1 done but not as wished, 2 wrong input, 3 device or run failure, 130 interrupted.
"""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: the process's own) and return its exit status. Does not raise for a user's
    mistake."""
    from gradcal_jax.cli.app import run

    return run(arguments)
