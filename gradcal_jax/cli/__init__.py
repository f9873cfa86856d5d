"""The `gradcal` command. Nothing heavy is imported before a command that needs it runs.

Exit statuses: 0 done, 1 done but not as wished, 2 wrong input, 3 device or run failure, 130 interrupted.
"""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: the process's own) and return its exit status. Never raises for a user's slip."""
    from gradcal_jax.cli.app import run

    return run(arguments)
