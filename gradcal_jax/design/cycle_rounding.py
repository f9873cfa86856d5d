"""A cycle of turns and rests in numbers that controllers take."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.design.slots import SHAPE, Cycle, TableLimits, Visits

# A smaller turn, deg, says nothing of a sensor, and is lost among the readings about it.
_SHOWS = 0.5
# Resolution of turns (deg), rates (deg/s) and rests (s) in a plan.
_ANGLE, _RATE, _FINE_RATE, _REST = 0.01, 0.1, 0.01, 0.1
# Share of the largest rate beyond which a turn keeps its rate when it is rounded.
_FASTEST = 0.98
_SLACK = 1e-9


class RoundedTurn(NamedTuple):
    """A turn of `axis` (−1: none) by `angle` deg at a peak of `rate` deg/s in `duration` s, then a rest of `rest` s."""

    axis: int
    angle: float
    rate: float
    duration: float
    rest: float


class CycleRounding(NamedTuple):
    """Of cycles on the `axes` of a table within `limits`: the controllers' step of time `grid` (s), and whether a cycle
    is `closed`."""

    limits: TableLimits
    axes: tuple[str, ...]
    grid: float
    closed: bool

    def rounded(
        self, cycle: Cycle, period: float, start: Float[np.ndarray, " L"], whole: Float[np.ndarray, " L"] | None
    ) -> list[RoundedTurn]:
        """Rounded turns, rates and rests of a cycle from `start` (rad) that fit into the `period` (s) and turn every
        axis by the `whole` (rad; None: by any angle)."""
        items, goals, here = list[RoundedTurn](), np.zeros(len(start)), np.zeros(len(start))
        for axis, angle, rate, rest in cycle:
            turned = 0.0
            if axis >= 0:
                # Poses are rounded: errors of turns would add up. A turn that shows nothing joins the axis's next one.
                goals[axis] += math.degrees(angle)
                turned = self._within(axis, goals[axis], start) - here[axis]
                turned = round(turned, 6) if abs(turned) >= _SHOWS else 0.0
                here[axis] += turned
            rest = round(max(round(rest / _REST) * _REST, self.limits.shortest), 6) if rest > 0.0 else 0.0
            if turned or rest:
                items.append(self._turn(axis if turned else -1, turned, math.degrees(rate), rest))
        if whole is not None:
            for axis in {item.axis for item in items if item.angle}:
                k = max(k for k, item in enumerate(items) if item.axis == axis)
                last = items[k]
                items[k] = self._turn(axis, last.angle - here[axis] + math.degrees(whole[axis]), last.rate, last.rest)

        # The longest rests share what the controllers' steps of time cost, or leave.
        rests = sorted((k for k, item in enumerate(items) if item.rest), key=lambda k: -items[k].rest)
        change = math.floor((period - _lasting(items)) / _REST + _SLACK)
        for number in range(abs(change)) if rests else ():
            k = rests[number % len(rests)]
            rest = round(items[k].rest + math.copysign(_REST, change), 6)
            items[k] = items[k]._replace(rest=max(rest, self.limits.shortest))
        over = _lasting(items) - period
        if over > _SLACK and whole is None:
            # The rests are the shortest: the largest turn ends earlier.
            k = max(range(len(items)), key=lambda k: abs(items[k].angle))
            axis, angle, rate, _, rest = items[k]
            less = rate * (math.ceil(over / self.grid - _SLACK) + 1) * self.grid
            items[k] = self._turn(axis, math.copysign(max(abs(angle) - less, 0.0), angle), rate, rest)
        return items

    def visits(self, cycle: Cycle, of: Visits) -> list[tuple[list[RoundedTurn], float]]:
        """The rounded cycle of each visit, and how long other axes have the table after it (s): until the next one."""
        result, start, now = [], self.limits.start.copy(), 0.0
        last = max((group for t, group in zip(cycle, of.group, strict=True) if t.axis >= 0), default=0)
        for visit in range(of.number):
            part = tuple(t for t, group in zip(cycle, of.group, strict=True) if group == visit)
            closing = self.closed and visit == last
            turns = self.rounded(part, of.own, start, self.limits.start - start if closing else None)
            now += _lasting(turns)
            wait = math.floor(((visit + 1) * (of.own + of.other) - now) / self.grid + _SLACK) * self.grid
            # The others' time is of whole seconds: a fraction would be a reading of its own, soon after the last one.
            left = round(wait - math.floor(wait + _SLACK), 6)
            resting = [k for k, t in enumerate(turns) if t.rest]
            if left > 0.0 and resting:
                k = max(resting, key=lambda k: turns[k].rest)
                turns[k] = turns[k]._replace(rest=round(turns[k].rest + left, 6))
                now, wait = now + left, round(wait - left, 6)
            result.append((turns, wait))
            now += wait
            for t in turns:
                start[t.axis] += math.radians(t.angle)
        return result

    def _within(self, axis: int, goal: float, start: Float[np.ndarray, " L"]) -> float:
        """The nearest pose (deg from the start) in whole steps that an axis reaches."""
        low, high = np.degrees(self.limits.reach[axis] - start[axis]) / _ANGLE
        return float(np.clip(round(goal / _ANGLE), np.ceil(low - _SLACK), np.floor(high + _SLACK))) * _ANGLE

    def _turn(self, axis: int, angle: float, rate: float, rest: float) -> RoundedTurn:
        """A turn in whole steps of the controllers' time: steepest, in the nearest number of steps that its limits
        allow; one near its largest rate, which says most, keeps it."""
        angle = round(angle, 6)
        if axis < 0 or not angle:
            return RoundedTurn(-1, 0.0, 0.0, 0.0, rest)
        size, grid, most = math.radians(abs(angle)), self.grid, float(self.limits.rates[axis])
        coarsest = math.floor(math.degrees(most) / _RATE + _SLACK) * _RATE
        rate = round(min(math.ceil(rate / _RATE - _SLACK) * _RATE, coarsest), 6)
        # θ = A·(duration − ramp), with ramp = steep·A and no flat part at the least.
        steep = 1.0 / float(self.limits.accelerations[axis])
        peaks = (min(w, math.sqrt(size / steep)) for w in (math.radians(rate), most))
        planned, quickest = ((size / w + steep * w) / grid for w in peaks)
        duration = max(round(planned), math.ceil(quickest - _SLACK)) * grid
        if math.radians(rate) >= _FASTEST * most:
            duration = math.ceil(planned - _SLACK) * grid
            peak = min(rate, math.degrees(most))
        else:
            peak = 2.0 * size / (duration + math.sqrt(max(duration**2 - 4.0 * steep * size, 0.0)))
            peak = min(math.ceil(math.degrees(peak) / _FINE_RATE - _SLACK) * _FINE_RATE, math.degrees(most))
        return RoundedTurn(axis, angle, min(peak, math.degrees(2.0 * size / duration)), duration, rest)

    def moves(self, turns: list[RoundedTurn]) -> list[dict[str, Any]]:
        """Rounded turns as a list of moves for a spec."""
        moves: list[dict[str, Any]] = []
        for t in turns:
            if t.angle:
                turn = {"turn": f"{t.angle:.10g} deg", "axis": self.axes[t.axis], "shape": SHAPE}
                moves.append(turn | {"peak_rate": f"{t.rate:.8g} deg/s", "duration": f"{t.duration:.8g} s"})
            if t.rest:
                moves.append({"rest": f"{t.rest:.6g} s"})
        return moves


def _lasting(items: list[RoundedTurn]) -> float:
    """The time of turns and rests, s."""
    return math.fsum(item.duration + item.rest for item in items)
