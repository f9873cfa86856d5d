"""Changes of a cycle's structure (which axis turns, in what order, how many turns), and random cycles: between them and
the descent of `pose_cycle`, which changes numbers, a search covers all cycles."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gradcal_jax.design.slots import Cycle, SlotTurn, TableLimits

# A turn below this (rad) is none.
_NOTHING = 1e-6
# Angles (rad) of inserted turns: to neighbouring poses, and by whole turns.
_ANGLES = tuple(math.radians(a) for a in (45.0, 90.0, 135.0, 180.0, 360.0, 720.0, 1080.0))
# Probabilities of each change; several are made at once with the probability `_AGAIN`.
_CHANGES = {
    "swap": 0.2,
    "delete": 0.18,
    "insert": 0.16,
    "angle": 0.16,
    "axis": 0.1,
    "block": 0.1,
    "reverse": 0.05,
    "copy": 0.05,
}
_AGAIN = 0.25


@dataclass(frozen=True)
class Neighbourhood:
    """Changes within the limits of a table, for cycles of at most `most` turns."""

    limits: TableLimits
    most: int

    def neighbour(self, cycle: Cycle, rng: np.random.Generator) -> Cycle:
        """A cycle with one change or several."""
        for _ in range(20):
            changed = self._changed(list(cycle), rng)
            while rng.random() < _AGAIN:
                changed = self._changed(list(changed), rng)
            if changed != cycle and 2 <= len(changed) <= self.most:
                return changed
        return cycle

    def _changed(self, items: list[SlotTurn], rng: np.random.Generator) -> Cycle:
        k = int(rng.integers(len(items)))
        item = items[k]
        what = rng.choice(list(_CHANGES), p=list(_CHANGES.values()))
        if what == "swap":
            other = int(rng.integers(len(items))) if rng.random() < 0.5 else (k + 1) % len(items)
            items[k], items[other] = items[other], items[k]
        elif what == "insert":
            items.insert(k, self._drawn(rng))
        elif what == "delete" and len(items) > 2:
            del items[k]
        elif what == "axis":
            axis = int(rng.integers(len(self.limits.rates)))
            items[k] = item._replace(axis=axis, rate=min(item.rate, float(self.limits.rates[axis])))
        elif what == "reverse":
            items[k] = item._replace(angle=-item.angle)
        elif what == "copy":
            # The opposite move, which cancels drift.
            items.insert(k + 1, item._replace(angle=-item.angle))
        elif what == "angle":
            items[k] = item._replace(angle=item.angle + float(rng.choice(_ANGLES)) * _sign(rng))
        elif what == "block":
            block = items[k : k + int(rng.integers(2, 7))]
            del items[k : k + len(block)]
            at = int(rng.integers(len(items) + 1))
            items[at:at] = block if rng.random() < 0.7 else block[::-1]
        return self.within(items)

    def random(self, count: int, rng: np.random.Generator) -> Cycle:
        """A random cycle of `count` turns."""
        return self.within([self._drawn(rng) for _ in range(count)])

    def within(self, items: Sequence[SlotTurn]) -> Cycle:
        """The cycle with turns no larger than the largest, on axes of limited travel within their reach."""
        here, result = self.limits.start.copy(), []
        for t in items:
            angle = float(np.clip(t.angle, -self.limits.largest, self.limits.largest))
            if t.axis >= 0:
                low, high = self.limits.reach[t.axis]
                # A turn beyond one end goes the other way.
                if not low <= here[t.axis] + angle <= high:
                    angle = -angle
                goal = float(np.clip(here[t.axis] + angle, low, high))
                angle, here[t.axis] = goal - here[t.axis], goal
            # On an axis at its end, nothing is left of a turn.
            if t.axis < 0 or abs(angle) > _NOTHING:
                result.append(t._replace(angle=float(angle)))
        return tuple(result)

    def _drawn(self, rng: np.random.Generator) -> SlotTurn:
        axis = int(rng.integers(len(self.limits.rates)))
        angle = float(rng.choice(_ANGLES)) * _sign(rng)
        rate = float(self.limits.rates[axis]) * float(rng.uniform(0.1, 1.0))
        return SlotTurn(axis, angle, rate, self.limits.shortest + float(rng.exponential(6.0)))


def _sign(rng: np.random.Generator) -> int:
    return int(rng.choice((-1, 1)))
