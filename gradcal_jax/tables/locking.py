"""Locks on files, which the operating system releases when their owner dies."""

import os
import sys

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


def take(handle: int) -> None:
    """Lock an open file for this process alone. Raises `OSError` at once where another one has it."""
    if sys.platform == "win32":
        os.lseek(handle, 0, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
