"""Parts of one run on a table: cut at times, and joined across pauses.

In a pause nothing is read and every axis returns to the angle at which the next part begins, up to whole turns. The
noise continues; at the end of the pause the angles have a new origin, in a standstill of their own.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.formulas import CONSTANT
from gradcal_jax.trajectory.trajectory import Trajectory

# Fractions of a piece nearer than this to one of its ends divide nothing.
_EDGE = 1e-9


class TablePart(NamedTuple):
    """Pieces of a table's motion: `line`; the `axis` that each turns (−1: none) and its `mounting`, `(P,)`; the axes'
    angles (rad) at the begin, `(L,)`."""

    line: Trajectory
    axis: Int[np.ndarray, " P"]
    mounting: Int[np.ndarray, " P"]
    start: Float[np.ndarray, " L"]

    def between(self, begin: float, end: float, *, whole: bool) -> "TablePart | None":
        """The pieces that lie wholly between two times (s, in the time of the line); None: none.

        `whole`: rows are of whole rests and moves; of a rest at one of the times what lies between counts, of a move
        nothing.
        """
        part = self._divided(begin, end) if whole else self
        line = part.line
        kept = line.lying_between(begin, end)
        if whole:
            number = np.asarray(line.segment)
            kept &= (part.axis < 0) | ~np.isin(number, number[~kept & (part.axis >= 0)])
        if not np.any(kept & ~line.gap):
            return None
        first = int(np.flatnonzero(kept)[0])
        turned = np.where(part.axis[:first, None] == np.arange(len(part.start)), line.turned()[:first, None], 0.0)
        return TablePart(line.of_pieces(kept), part.axis[kept], part.mounting[kept], part.start + turned.sum(axis=0))

    def _divided(self, *times: float) -> "TablePart":
        """With rests divided at times (s), and read there."""
        line = self.line
        pieces, places = [], []
        for time in times:
            at = (time - line.start) / np.where(line.duration > 0.0, line.duration, 1.0)
            inside = np.flatnonzero((self.axis < 0) & (at > _EDGE) & (at < 1.0 - _EDGE))
            pieces.append(inside)
            places.append(at[inside])
        piece, place = np.concatenate(pieces), np.concatenate(places)
        if not len(piece):
            return self
        order = np.lexsort((place, piece))
        line, source = line.divided(piece[order], place[order])
        line = replace(line, read=line.read | (np.isin(source, piece) & ~line.gap))
        return TablePart(line, self.axis[source], self.mounting[source], self.start)

    def then(self, pause: float, after: "TablePart") -> "TablePart":
        """This part, a `pause` (s) and the part `after` it."""
        line, later, axes = self.line, after.line, len(self.start)
        each = np.arange(axes)
        turned = np.where(self.axis[:, None] == each, line.turned()[:, None], 0.0).sum(axis=0)
        back = after.start - self.start - turned
        back -= 2.0 * np.pi * np.round(back / (2.0 * np.pi))
        lasts = pause / axes
        ended, segment = line.start[-1] + line.duration[-1], line.segment[-1]
        none, yes = np.zeros(axes), np.ones(axes, bool)
        between = {
            "start": ended + lasts * each, "duration": np.full(axes, lasts), "u_start": none, "u_end": none + 1.0,
            "share": none + 1.0, "terms": (back / lasts)[:, None] * np.array([CONSTANT]),
            "level": np.full(axes, later.level[0] + later.excess[0]), "slope": none, "excess": none, "read": ~yes,
            "at_rest": yes, "moving": yes, "gap": yes, "segment": segment + 1 + each,
        }  # fmt: skip
        shifted = {
            "start": later.start - later.start[0] + ended + pause,
            "segment": later.segment - later.segment[0] + segment + axes + 1,
        }
        joined = {
            name: np.concatenate([getattr(line, name), values, shifted.get(name, getattr(later, name))])
            for name, values in between.items()
        }
        count, begins = line.piece_count, line.piece_count + axes
        moving = np.concatenate([line.moving_pieces, count + each, later.moving_pieces + begins])
        varying = np.concatenate([line.varying_pieces, later.varying_pieces + begins])
        whole = replace(later, **joined, moving_pieces=moving, varying_pieces=varying, has_gaps=True)
        axis = np.concatenate([self.axis, each, after.axis])
        mounting = np.concatenate([self.mounting, np.full(axes, after.mounting[0]), after.mounting])
        return TablePart(whole, axis, mounting, self.start)
