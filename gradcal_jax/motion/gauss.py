"""How pieces of a trajectory are integrated: the number of Gauss–Legendre nodes, and where functions of temperature are
not smooth."""

import numpy as np

from gradcal_jax.formulas import MOTION_TERMS
from gradcal_jax.motion.trajectory import Trajectory

# 16 nodes resolve a raised cosine to the fourth power, the fastest variation of a cubic M(T, ω), to 1e-12; each higher
# degree in rate adds a period, and two nodes. Cosine ramps and half sines have half as many periods: 10 nodes, and one
# more for each degree, are as accurate.
_MOVING_NODES = 16
_CUBIC = 3
_HALF_WAVE_NODES = 10
# Of each term of the motion family: its power of time (a wave: -1), and whether it is no faster than a half wave.
_POWERS = np.array([int(name[1:]) if name[0] == "u" else -1 for name in MOTION_TERMS])
_SLOW = (_POWERS >= 0) | np.isin(MOTION_TERMS, ("cos1", "sin1"))
# Divisions nearer than this to an end of a piece, or to each other, as a share of the piece, divide nothing.
EDGE = 1e-12
# Bisection steps that locate a crossing, to 2^-45 of a piece.
_HALVINGS = 45


def moving_nodes(line: Trajectory, of_temperature: int, of_rate: int) -> int:
    """Nodes of a turning piece, for functions of these degrees of a trajectory whose numbers are known."""
    nodes = _MOVING_NODES + 2 * max(0, of_rate - _CUBIC)
    # Linear ramps and splines are polynomials in time, which few nodes integrate exactly.
    present = np.asarray(line.terms)[np.asarray(line.moving)] != 0.0
    terms = np.any(present, axis=0)
    # The shape of a move is unknown if it does not turn here but may where the rule is used.
    if np.any(line.excess) or not np.all(np.any(present, axis=1)) or not np.all(_SLOW[terms]):
        return nodes
    exact = ((of_rate + 1) * int(np.max(_POWERS[terms], initial=0)) + of_temperature) // 2 + 1
    return min(nodes, exact if np.all(_POWERS[terms] >= 0) else _HALF_WAVE_NODES + of_rate)


def turning_points(line: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """The pieces, and the fractions of them, at which the temperature of a lagging sensor turns."""
    if not line.lagged:
        return np.zeros(0, int), np.zeros(0)
    # T' = slope − λ·excess·exp(−λt)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.log(line.lag_rate * line.excess / line.slope) / line.lag_rate / line.duration
    pieces = np.flatnonzero(np.isfinite(at) & (at > 0.0) & (at < 1.0))
    return pieces, at[pieces]


def crossings(line: Trajectory, level: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pieces, and the fractions of them, at which the temperature crosses the level (°C) of its piece between the
    fractions `low` and `high`, where it is monotone; `(P,)` each. Numbers must be known."""
    begin, end = (line.temperature(v[:, None])[:, 0] for v in (low, high))
    pieces = np.flatnonzero(~np.asarray(line.gap) & ((begin >= level) != (end >= level)))
    level, begin, end, low, high = (of[pieces] for of in (level, begin, end, low, high))
    if not line.lagged:
        return pieces, low + (high - low) * (level - begin) / (end - begin)
    above = begin >= level
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        same = (line.temperature(middle[:, None], pieces)[:, 0] >= level) == above
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return pieces, 0.5 * (low + high)


def temperature_crossings(line: Trajectory, breaks: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The pieces, and the fractions of them, at which the temperature crosses a break. Numbers must be known."""
    begin, turn, end = np.zeros(line.piece_count), np.ones(line.piece_count), np.ones(line.piece_count)
    where, at = turning_points(line)
    turn[where] = at
    found = [
        crossings(line, np.full(line.piece_count, level), *part)
        for level in breaks
        for part in ((begin, turn), (turn, end))
    ]
    pieces, places = (np.concatenate(of) for of in zip((np.zeros(0, int), np.zeros(0)), *found, strict=True))
    inside = (places > EDGE) & (places < 1.0 - EDGE)
    return pieces[inside], places[inside]
