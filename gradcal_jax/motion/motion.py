"""Moves of a table axis: shapes by name, resolved into smooth pieces.

A move is described by peak rate, duration and (for the shapes with ramps) ramp time; the angle follows. Reading the
spec computes these from what the user specifies. This module is plain NumPy: a move's *structure*, which `schedule`
turns into arrays with arbitrary times and rates.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.tables.display import summary

Division = tuple[tuple[float, ...], tuple[bool, ...]]
"""Division of a smooth part of a move: edges (fractions, 0 to 1), and whether each piece ends with a reading."""


class PieceTable(NamedTuple):
    """The smooth pieces `(k,)` of one move.

    A piece lasts `(u_end − u_start)·(by_duration·duration + by_ramp·ramp)` of its move's duration and ramp, and its
    rate is `peak_rate · terms·f(u)` (f: the motion family of `formulas`). Flags: a reading at the end; the axis stands
    at the end; the rate is not zero throughout; the rate is not constant.
    """

    by_duration: np.ndarray
    by_ramp: np.ndarray
    u_start: np.ndarray
    u_end: np.ndarray
    terms: np.ndarray
    read: np.ndarray
    at_rest: np.ndarray
    moving: np.ndarray
    varying: np.ndarray


@dataclass(frozen=True)
class Move:
    """A turn (any of `formulas.SHAPES`), or a rest (`shape="rest"`).

    `peak_rate` rad/s, signed; `duration` s, the whole move's; `ramp` s, each ramp's, of a turn by hand the standing
    before and after turning; `unevenness` of a turn by hand. `divisions`: of each smooth part.
    """

    shape: str
    duration: float
    divisions: tuple[Division, ...]
    peak_rate: float = 0.0
    ramp: float = 0.0
    unevenness: float = 0.0

    __repr__ = summary

    @property
    def pieces(self) -> PieceTable:
        """The pieces of the move."""
        if self.shape == "rest":
            return standing(self.divisions[0])
        return turning(self.shape, self.divisions, self.unevenness, stands=self.ramp > 0.0)


@lru_cache(maxsize=4096)
def standing(division: Division) -> PieceTable:
    """Standing for the move's duration."""
    edges, read = division
    count, at = len(read), np.asarray(edges)
    none = np.zeros(count, bool)
    terms = np.zeros((count, len(formulas.MOTION_TERMS)))
    return PieceTable(np.ones(count), np.zeros(count), at[:-1], at[1:], terms, np.array(read), ~none, none, none)


@lru_cache(maxsize=4096)
def turning(shape: str, divisions: tuple[Division, ...], unevenness: float, *, stands: bool = True) -> PieceTable:
    """A turn of unit peak rate with the division of each of its smooth parts; `stands`: see `formulas.shape_pieces`."""
    parts = formulas.shape_pieces(shape, unevenness=unevenness, stands=stands)
    blocks = []
    for i, ((what, coefficients), (edges, read)) in enumerate(zip(parts, divisions, strict=True)):
        count, at = len(read), np.asarray(edges)
        by_duration, by_ramp = (0.0, 1.0) if what == "ramp" else (1.0, -2.0)
        ends_move = np.arange(count) == (count - 1 if i == len(parts) - 1 else count)
        yes = np.ones(count, bool)
        lasting, rates = (np.full(count, by_duration), np.full(count, by_ramp)), np.tile(coefficients, (count, 1))
        blocks.append(
            PieceTable(*lasting, at[:-1], at[1:], rates, np.array(read), ends_move, yes, yes & (what != "flat"))
        )
    return joined(blocks)


def joined(blocks: list[PieceTable]) -> PieceTable:
    """Blocks of pieces, one after the other."""
    return PieceTable._make(np.concatenate(field) for field in zip(*blocks, strict=True))


@lru_cache(maxsize=4096)
def divide(duration: float, readings: tuple[float, ...], longest: float = np.inf) -> Division:
    """Divide a part of `duration` at its readings (from its start) into pieces no longer than `longest`."""
    if duration <= 0.0:
        return (0.0, 1.0), (bool(readings),)
    stops = [float(t) / duration for t in readings]
    ends = [*stops[:-1], 1.0] if stops and stops[-1] > 1.0 - 1e-9 else [*stops, 1.0]
    edges, read = [0.0], []
    for k, end in enumerate(ends):
        begin = edges[-1]
        count = max(1, int(np.ceil((end - begin) * duration / longest * (1.0 - 1e-9))))
        edges += [begin + (end - begin) * i / count for i in range(1, count)] + [end]
        read += [False] * (count - 1) + [k < len(stops)]
    return tuple(edges), tuple(read)


def rest(duration: float, read_every: float | None = None, *, read_at_end: bool = False) -> Move:
    """A rest of `duration` s, read every `read_every` s, at its end, or not at all.

    Errors: `ValueError` for a duration that is no number.
    """
    times = formulas.reading_times(float(duration), read_every)
    if read_at_end and (not times or times[-1] < duration):
        times.append(float(duration))
    return Move("rest", float(duration), (divide(float(duration), tuple(times)),))


def turn(
    shape: str,
    peak_rate: float,
    duration: float,
    *,
    ramp: float = 0.0,
    unevenness: float = 0.0,
    read_at_end: bool = True,
    read_every: float | None = None,
    longest_piece: float = np.inf,
) -> Move:
    """A turn from plain numbers: `peak_rate` rad/s, signed; `duration` and each `ramp` in s.

    `shape`: one of `formulas.SHAPES`; `unevenness` of a turn by hand. `read_at_end`: the angle is read where the turn
    ends. `read_every` reads also on the move; `read_at_end` then has no effect. `longest_piece` (a few of the shortest
    correlation time of the noise) divides the parts on which the rate varies.

    Errors: `ValueError` for an unknown shape or ramps longer than the move.
    """
    if 2.0 * ramp > duration * (1 + 1e-9):
        raise ValueError(
            f"two ramps of {ramp} s do not fit into a move of {duration} s: shorten the ramps or reduce the rate"
        )
    between = max(duration - 2.0 * ramp, 0.0)
    if shape not in formulas.RAMPS:
        # The rate of a hand oscillates four times, and its powers in M(T, ω) are too fast for one quadrature.
        longest_piece = min(longest_piece, between / 8)
    readings = formulas.reading_times(duration, read_every) or ([duration] if read_at_end else [])
    divisions, begin = [], 0.0
    parts = formulas.shape_pieces(shape, unevenness=unevenness, stands=ramp > 0.0)
    for i, (what, _) in enumerate(parts):
        part = ramp if what == "ramp" else between
        last = i == len(parts) - 1
        inside = [t - begin for t in readings if t > begin + 1e-12 * duration and (last or t <= begin + part)]
        times = tuple(min(t, part) for t in inside)
        divisions.append(divide(part, times, np.inf if what == "flat" else longest_piece))
        begin += part
    return Move(shape, float(duration), tuple(divisions), float(peak_rate), float(ramp), unevenness)
