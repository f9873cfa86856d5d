"""The size that a compressed file declares, before it is believed: a small file can hold little."""

from typing import Final

_ALWAYS: Final = 256 * 1024**2
_TIMES: Final = 100


def check_size(declared: int, stored: int) -> None:
    """Raise `ValueError` where a file of `stored` bytes declares data of more than 256 MiB and 100 times its size."""
    limit = max(_ALWAYS, _TIMES * stored)
    if declared > limit:
        raise ValueError(
            f"it declares {declared / 1e6:.0f} MB of data in a file of {stored / 1e6:.1f} MB; the limit for a file of "
            f"this size is {limit / 1e6:.0f} MB"
        )
