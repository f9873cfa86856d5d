"""Calibration without a structure, as in the paper: averages of moves that are near in time and temperature.

Every move between two rests is an experiment of its own. The drift in the rests before and after it, its closest
neighbours in time, is subtracted from the move's error in angle; the remainder over the angle is the scale factor of
that move. Moves of one rate within a few kelvins are then averaged. No map is assumed, and the scatter gives the
standard error of the mean: an independent check of the fitted map with a larger error, since it uses neither the
correlation of the noise nor other moves.
"""

from typing import NamedTuple

import numpy as np

# Relative difference below which rates are equal.
_ALIKE = 0.1
# Least angle of a move (rad) for a scale factor.
_LEAST_ANGLE = np.radians(1.0)


class MovesBetweenRests(NamedTuple):
    """Moves between rests, arrays `(m,)`: mean temperature (°C), mean rate (rad/s), angle (rad), its scale
    factor, and the fitted map's mean over it."""

    temperature_c: np.ndarray
    rate_rad_per_s: np.ndarray
    angle_rad: np.ndarray
    scale_factor: np.ndarray
    of_map: np.ndarray


class Group(NamedTuple):
    """`moves` neighbours' mean scale factor with its standard error, from the scatter of all groups of
    that rate (None where each has a single move), beside the map's mean."""

    temperature_c: float
    rate_rad_per_s: float
    moves: int
    scale_factor: float
    standard_error: float | None
    of_map: float


def moves_between_rests(
    error_rad: np.ndarray,
    map_error_rad: np.ndarray,
    turned_rad: np.ndarray,
    duration_s: np.ndarray,
    temperature_c: np.ndarray,
    moving: np.ndarray,
    broken: np.ndarray,
) -> MovesBetweenRests:
    """Every unbroken move with a rest on both sides. All arrays `(P,)` of a timeline's pieces.

    `error_rad`: integrated error of the sensor at the end of each piece; `map_error_rad`: its part from the fitted
    scale factor; `turned_rad`: angle of the table over each piece.
    """
    before = np.concatenate([[0.0], error_rad[:-1]])
    by_map = np.diff(map_error_rad, prepend=0.0)
    runs = _runs(moving, broken)
    rows: list[tuple[float, ...]] = []
    for number, (first, last) in enumerate(runs):
        if not moving[first]:
            continue
        angle = float(turned_rad[first : last + 1].sum())
        sides = [runs[k] for k in (number - 1, number + 1) if 0 <= k < len(runs)]
        sides = [run for run in sides if not moving[run[0]] and not broken[run[0]]]
        if broken[first] or len(sides) < 2 or abs(angle) < _LEAST_ANGLE:
            continue
        drift = np.mean([(error_rad[b] - before[a]) / max(duration_s[a : b + 1].sum(), 1e-12) for a, b in sides])
        lasting = float(duration_s[first : last + 1].sum())
        off = error_rad[last] - before[first] - drift * lasting
        warm = float(np.average(temperature_c[first : last + 1], weights=duration_s[first : last + 1]))
        rows.append((warm, angle / lasting, angle, off / angle, float(by_map[first : last + 1].sum()) / angle))
    return MovesBetweenRests(*np.array(rows).reshape(len(rows), 5).T)


def _runs(moving: np.ndarray, broken: np.ndarray) -> list[tuple[int, int]]:
    """First and last piece of each run of pieces of one kind."""
    kind = moving.astype(int) + 2 * broken
    begins = np.flatnonzero(np.diff(kind, prepend=-1))
    ends = np.append(begins[1:], len(kind)) - 1
    return [(int(a), int(b)) for a, b in zip(begins, ends, strict=True)]


def closest_neighbours(moves: MovesBetweenRests, width_k: float) -> tuple[Group, ...]:
    """Moves of like rate, in ranges of temperature `width_k` wide, averaged; by rate, then by temperature.

    Errors: `ValueError` for a width that is not positive.
    """
    if not width_k > 0.0:
        raise ValueError(f"neighbours must be allowed to be some kelvins apart, not {width_k}")
    if not len(moves.angle_rad):
        return ()
    like = like_rates(moves.rate_rad_per_s, _ALIKE)
    warm = np.floor((moves.temperature_c - moves.temperature_c.min()) / width_k).astype(int)
    # Without the map's mean, so that its slope within a group is no scatter.
    apart_from_map = moves.scale_factor - moves.of_map
    groups: list[Group] = []
    for one in np.unique(like):
        parts = [(like == one) & (warm == at) for at in np.unique(warm[like == one])]
        freedom = sum(int(inside.sum()) - 1 for inside in parts)
        # A few moves do not determine their scatter, which is therefore pooled over all groups of one rate.
        squares = sum(float(np.sum((v := apart_from_map[inside]) ** 2) - np.sum(v) ** 2 / len(v)) for inside in parts)
        scatter = np.sqrt(max(squares, 0.0) / freedom) if freedom else None
        for inside in parts:
            count = int(inside.sum())
            warm_c, rate, _, scale, of_map = (float(of[inside].mean()) for of in moves)
            error = None if scatter is None else float(scatter / np.sqrt(count))
            groups.append(Group(warm_c, rate, count, scale, error, of_map))
    return tuple(groups)


def like_rates(rates: np.ndarray, share: float) -> np.ndarray:
    """`(n,)`: numbers of the groups of `rates` `(n,)` whose neighbours lie within that share of one another."""
    order = np.argsort(rates)
    ordered = rates[order]
    apart = np.diff(ordered) > share * np.maximum(np.abs(ordered[1:]), np.abs(ordered[:-1]))
    like = np.empty(len(order), int)
    like[order] = np.concatenate([[0], np.cumsum(apart)])
    return like
