"""Output for people: factors from SI, and times in words."""

import math
from typing import Final

# Factors from SI (ratios, rad/s, rad/√s, rad) to the units of reports.
PPM: Final = 1e6
# m/s² in one g (BIPM, CGPM 1901).
G: Final = 9.80665
DEG_PER_S: Final = 180.0 / math.pi
DEG_PER_H: Final = 3600.0 * 180.0 / math.pi
DEG_PER_SQRT_H: Final = 60.0 * 180.0 / math.pi
ARCSEC: Final = 3600.0 * 180.0 / math.pi


def time_text(seconds: float) -> str:
    """Hours, minutes and seconds as people say them: '2 h 40 min', '45.45 s'."""
    if seconds < 120.0:
        return f"{seconds:.4g} s"
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    minutes, left = divmod(rest, 60)
    parts = [f"{hours} h"] if hours else []
    parts += [f"{minutes} min"] if minutes else []
    parts += [f"{left} s"] if left and hours < 10 else []
    return " ".join(parts) if parts else "0 s"


def count_text(number: int, noun: str) -> str:
    """A number of things: '1 step', '17 steps'."""
    return f"{number} {noun}" + "s" * (number != 1)


def times_text(duration_s: float, soak_s: float, motion_s: float, motion: str = "motion") -> str:
    """Durations of a plan, its soaks and its motion."""
    return f"{time_text(duration_s)} in all: soak {time_text(soak_s)}, {motion} {time_text(motion_s)}"
