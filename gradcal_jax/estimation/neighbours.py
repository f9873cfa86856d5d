"""Calibration without a structure, as in the paper: averages of moves that are near in time and temperature.

Every move between two rests is an experiment of its own. The drift in the rests before and after it, its closest
neighbours in time, is subtracted from the move's error in angle; the remainder over the angle is the scale factor of
that move. Moves of one rate within a few kelvins are then averaged. No map is assumed, and the scatter gives the
standard error of the mean: an independent check of the fitted map with a larger error, since it uses neither the
correlation of the noise nor other moves.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.imu_readings import ImuReadings
from gradcal_jax.estimation.imu_solve import ImuEstimate
from gradcal_jax.information import segments_of
from gradcal_jax.model import SCALE_FACTOR

# Relative difference below which rates are equal.
_ALIKE = 0.1
# Least angle of a move (rad) for a scale factor.
_LEAST_ANGLE = np.radians(1.0)
# Share of a table's turn that a gyro senses of one about its own axis.
_OWN_AXIS = 1.0 - 1e-4


class MovesBetweenRests(NamedTuple):
    """Moves between rests, arrays `(m,)`: mean temperature (°C), mean rate (rad/s), scale factor, and the fitted map's
    mean over it."""

    temperature_c: np.ndarray
    rate_rad_per_s: np.ndarray
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
    """Every unbroken move with a rest on both sides. All arrays `(P,)` of a timeline's pieces: of each the integrated
    error of the sensor, its part from the fitted scale factor, and the angle of the table."""
    kind = moving.astype(int) + 2 * broken
    begins = np.flatnonzero(np.diff(kind, prepend=-1))
    kind = kind[begins]
    pieces = error_rad, map_error_rad, turned_rad, duration_s, temperature_c * duration_s
    error, by_map, angle, lasting, warm = (np.add.reduceat(of, begins) for of in pieces)
    drift = error / np.maximum(lasting, 1e-12)
    turns = (kind[1:-1] == 1) & (np.abs(angle[1:-1]) >= _LEAST_ANGLE)
    m = 1 + np.flatnonzero(turns & (kind[:-2] == 0) & (kind[2:] == 0))
    off = error[m] - 0.5 * (drift[m - 1] + drift[m + 1]) * lasting[m]
    return MovesBetweenRests(warm[m] / lasting[m], angle[m] / lasting[m], off / angle[m], by_map[m] / angle[m])


def closest_neighbours(moves: MovesBetweenRests, width_k: float) -> tuple[Group, ...]:
    """Moves of like rate, in ranges of temperature `width_k` wide, averaged; by rate, then by temperature.

    Errors: `ValueError` for a width that is not positive.
    """
    if not width_k > 0.0:
        raise ValueError(f"the temperature difference of neighbours must be positive, not {width_k}")
    if not len(moves.scale_factor):
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
            warm_c, rate, scale, of_map = (float(of[inside].mean()) for of in moves)
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


def neighbours_of(readings: ImuReadings, solution: ImuEstimate, width_k: float) -> dict[str, tuple[Group, ...]]:
    """The groups of every gyro with a scale factor, by its name, of moves about its own axis; gyros without such moves
    are left out. Errors: `ValueError` for a width that is not positive."""
    motion, model, result = readings.done.motion, readings.model, dict[str, tuple[Group, ...]]()
    if motion.line.rates:
        return result
    at, nodes = segments_of(motion, model), readings.nominal()

    def along(of_group, shape: tuple[int, ...]) -> np.ndarray:
        return np.asarray(at.sums(nodes.integrals(of_group, shape)[nodes.kind]))

    turned = along(lambda g: g.integral(g.rate - g.earth), (3,))
    path = along(lambda g: g.integral(np.linalg.norm(g.rate - g.earth, axis=-1)), ())
    error = readings.observed - readings.expected(np.zeros(model.size))
    ends, moving = readings.temperature_c[readings.done.rows], np.asarray(at.axis) >= 0
    warm, seconds = 0.5 * (ends[at.first] + ends[at.last + 1]), np.asarray(at.sums(motion.line.duration))
    for i, (c, columns) in enumerate(zip(model.channels, model.own_columns(nodes), strict=True)):
        own = c.where(SCALE_FACTOR)
        if c.kind != "gyro" or own.start == own.stop:
            continue
        rows, of_channel = at.row_channel == i, np.zeros(len(at.first))
        of_channel[at.row_segment[rows]] = error[rows]
        scale = solution.parameters[model.where(c.kind, c.axis, SCALE_FACTOR)]
        by_map = np.asarray(at.sums(columns[:, own])) @ scale
        beside = moving & (np.abs(turned[:, c.axis]) < _OWN_AXIS * path)
        broken = np.asarray(motion.line.gap)[at.first] | beside
        moves = moves_between_rests(of_channel, by_map, turned[:, c.axis], seconds, warm, moving, broken)
        if groups := closest_neighbours(moves, width_k):
            result[c.name] = groups
    return result
