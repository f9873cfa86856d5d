"""A whole unit's rows as a problem that other packages can be given: six channels that share two encoders.

State `x = [6 integrals, 6 drifts, 2 encoder errors now, 2 before the last move]`. A segment is a rest, which all six
channels read, or a move of one of two axes, which the three gyros do: a reading of channel i is its integral over the
segment and, as a row of H, shares of the encoders' errors; a move draws its axis's error anew. White noise and drifts
are those of a tactical unit; Φ is made of smooth waves.
"""

from typing import NamedTuple

import numpy as np

from peers.problem import smooth_columns

_DEG = np.pi / 180.0
STATES = 16
_REST, _MOVE = 6.0, 5.0
_CORRELATION = np.repeat([120.0, 200.0], 3)
_DRIFT = np.repeat([_DEG / 3600.0, 50e-6 * 9.8], 3)
_WHITE = np.repeat([0.15 * _DEG / 60.0, 0.05 / 60.0], 3)
_ENCODER = 7.0 * _DEG / 3600.0


class UnitProblem(NamedTuple):
    """`columns` `(N, p)`; of the S segments `durations` s and the axis that `moves` (−1: none). Of every row its
    `segment`, whether it is the segment's `first`, and its `observation` `(N, 16)`; `prior` `(p,)`.
    """

    columns: np.ndarray
    durations: np.ndarray
    moves: np.ndarray
    segment: np.ndarray
    first: np.ndarray
    observation: np.ndarray
    prior: np.ndarray


def make_problem(count: int, parameters: int, seed: int = 0) -> UnitProblem:
    """`count` rows: rests and moves in turn, an axis there and back before the other."""
    rng = np.random.default_rng(seed)
    pattern = np.array([-1, 0, -1, 0, -1, 1, -1, 1])
    moves = np.tile(pattern, count // 36 + 2)
    channels = [range(6) if axis < 0 else range(3) for axis in moves]
    segment = np.repeat(np.arange(len(moves)), [len(c) for c in channels])[:count]
    channel = np.concatenate(channels)[:count]
    moves = moves[: segment[-1] + 1]
    durations = np.where(moves < 0, _REST, _MOVE) * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, len(moves)))
    observation = np.zeros((count, STATES))
    observation[np.arange(count), channel] = 1.0
    size = np.where(channel < 3, 1.0, 40.0)[:, None]
    share = size * rng.uniform(-1.0, 1.0, (count, 2))
    turning = moves[segment][:, None] == np.arange(2)
    observation[:, 12:14], observation[:, 14:] = share, np.where(turning, -share, 0.0)
    time = np.cumsum(durations)[segment]
    columns = smooth_columns(time, time[-1], parameters, rng) * _WHITE[channel][:, None]
    prior = 1e-6 * np.sum((columns / _WHITE[channel][:, None]) ** 2, axis=0)
    return UnitProblem(columns, durations, moves, segment, np.diff(segment, prepend=-1) > 0, observation, prior)


def steps_of(problem: UnitProblem, durations, xp):
    """`F` and `Q` of the step to each segment's first row, `(S, 16, 16)`: over NumPy (any precision) or JAX."""
    zeros = xp.zeros((len(problem.durations), STATES, STATES), dtype=durations.dtype)
    x = durations[:, None] / _CORRELATION
    faded, power = -xp.expm1(-x), 2.0 * _DRIFT**2 / _CORRELATION
    # (2x − 3 + 4e^(−x) − e^(−2x))/2 = x³/3 − x⁴/4 + …: twelve terms reach 1e-19 for x below 0.1, as all are.
    cubic, term = xp.zeros_like(x), x**3 / 6
    for k in range(12):
        cubic = cubic + term * (2.0 ** (k + 2) - 2.0) * (-1.0) ** k
        term = term * x / (k + 4)
    own, slow = np.arange(6), np.arange(6, 12)
    moved = (problem.moves[:, None] == np.arange(2)).astype(float)
    now, before = np.arange(12, 14), np.arange(14, 16)
    white = _WHITE**2 * durations[:, None] + power * _CORRELATION**3 * cubic
    cross, drawn = power * _CORRELATION**2 * faded**2 / 2, power * _CORRELATION * -xp.expm1(-2 * x) / 2
    transition = [(own, slow, _CORRELATION * faded), (slow, slow, 1 - faded)]
    transition += [(now, now, 1 - moved), (before, before, 1 - moved), (before, now, moved)]
    noise = [(own, own, white), (own, slow, cross), (slow, own, cross), (slow, slow, drawn)]
    noise += [(now, now, _ENCODER**2 * moved)]

    def put(parts):
        result = zeros
        for i, j, values in parts:
            if xp is np:
                result = result.copy()
                result[:, i, j] = values
            else:
                result = result.at[:, i, j].set(values)
        return result

    return put(transition), put(noise)


def initial() -> np.ndarray:
    """Covariance before the first step."""
    return np.diag(np.concatenate([np.zeros(6), _DRIFT**2, np.full(2, _ENCODER**2), np.zeros(2)]))


def exact_information(problem: UnitProblem, durations=None, columns=None) -> np.ndarray:
    """The textbook filter of the noise, one reading after the other, in extended precision (80 bits on x86)."""
    wide = np.longdouble
    durations = np.asarray(problem.durations if durations is None else durations, wide)
    columns = np.asarray(problem.columns if columns is None else columns, wide)
    transition, noise = steps_of(problem, durations, np)
    covariance, state = initial().astype(wide), np.zeros((STATES, columns.shape[1]), wide)
    white = np.empty_like(columns)
    for k, (row, h) in enumerate(zip(columns, problem.observation, strict=True)):
        if problem.first[k]:
            f, q = transition[problem.segment[k]], noise[problem.segment[k]]
            covariance, state = f @ covariance @ f.T + q, f @ state
        cross = covariance @ h
        spread, error = h @ cross, row - h @ state
        white[k] = error / np.sqrt(spread)
        state = state + np.outer(cross, error) / spread
        covariance = covariance - np.outer(cross, cross) / spread
    return white.T @ white + np.diag(np.asarray(problem.prior, wide))
