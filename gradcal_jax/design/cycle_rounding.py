"""A cycle of turns and rests in numbers that controllers take."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.design.slots import SHAPE, Cycle, SlotTurn, TableLimits, Visits

# A smaller turn, deg, says nothing of a sensor, and is lost among the readings about it.
_SHOWS = 0.5
# Resolution of turns (deg), rates (deg/s) and rests (s) in a plan.
_ANGLE, _RATE, _FINE_RATE, _REST = 0.01, 0.1, 0.01, 0.1
# Share of the largest rate beyond which a turn keeps its rate when it is rounded.
_FASTEST = 0.98
_SLACK = 1e-9


class CycleRounding(NamedTuple):
    """Of cycles on the `axes` of a table within `limits`: the controllers' step of time `grid` (s), and whether a cycle
    is `closed`."""

    limits: TableLimits
    axes: tuple[str, ...]
    grid: float
    closed: bool

    def rounded(self, cycle: Cycle, period: float, whole: Float[np.ndarray, " L"]) -> Cycle:
        """Rounded turns, rates and rests that fit into the `period` (s) and turn every axis by the `whole` (rad)."""
        items, goals, here = [], {}, {}
        bounded = np.flatnonzero(np.isfinite(self.limits.reach[:, 1]))
        for t in cycle:
            degrees, rate = math.degrees(t.angle), math.degrees(t.rate)
            if t.axis >= 0:
                # Poses are rounded: errors of turns would add up.
                goals[t.axis] = goals.get(t.axis, 0.0) + degrees
                degrees = self._within(t.axis, goals[t.axis]) - here.get(t.axis, 0.0)
                here[t.axis] = here.get(t.axis, 0.0) + degrees
                most = math.floor(math.degrees(float(self.limits.rates[t.axis])) / _RATE + _SLACK) * _RATE
                rate = min(math.ceil(rate / _RATE - _SLACK) * _RATE, most)
            rest = max(round(t.rest / _REST) * _REST, self.limits.shortest) if t.rest > 0.0 else 0.0
            items.append([t.axis, round(degrees, 6), round(rate, 6), round(rest, 6)])
        for axis, total in here.items() if self.closed else ():
            last = max(k for k, item in enumerate(items) if item[0] == axis)
            items[last][1] = round(items[last][1] - total + math.degrees(float(whole[axis])), 6)
        for item in items:
            # A turn that shows nothing: another one of its axis takes it along.
            if item[0] >= 0 and 0.0 < abs(item[1]) < _SHOWS and not (item[0] in bounded and not self.closed):
                largest = max((of for of in items if of[0] == item[0]), key=lambda of: abs(of[1]))
                if largest is not item:
                    largest[1], item[1] = round(largest[1] + item[1], 6), 0.0
        items = [item for item in items if item[1] or item[3]]

        # The longest rests share what the controllers' steps of time cost, or leave.
        turning = (self._made(l, a, w)[1] for l, a, w, _ in items if l >= 0 and a)
        rests = sorted((item for item in items if item[3]), key=lambda item: -item[3])
        change = math.floor((period - math.fsum([*turning, *(item[3] for item in items)])) / _REST + _SLACK)
        for k in range(abs(change)) if rests else ():
            item = rests[k % len(rests)]
            item[3] = max(round(item[3] + math.copysign(_REST, change), 6), self.limits.shortest)
        over = math.fsum([*(self._made(l, a, w)[1] for l, a, w, _ in items if l >= 0 and a), *(i[3] for i in items)])
        if over > period + _SLACK and not self.closed:
            # The rests are the shortest: the largest turn ends earlier.
            longest = max(items, key=lambda item: abs(item[1]))
            less = longest[2] * (math.ceil((over - period) / self.grid - _SLACK) + 1) * self.grid
            longest[1] = round(math.copysign(max(abs(longest[1]) - less, 0.0), longest[1]), 6)
        return tuple(SlotTurn(l, math.radians(a), math.radians(w), r) for l, a, w, r in items)

    def visits(self, cycle: Cycle, of: Visits) -> list[tuple[Cycle, float]]:
        """The rounded cycle of each visit, and how long other axes have the table after it (s): until the next one."""
        result, start, now = [], self.limits.start, 0.0
        for visit in range(int(of.group[-1]) + 1):
            part = tuple(t for t, group in zip(cycle, of.group, strict=True) if group == visit)
            here = self._replace(limits=self.limits._replace(start=start))
            turns = here.rounded(part, of.own, np.zeros(len(start)))
            made = (self._made(t.axis, math.degrees(t.angle), math.degrees(t.rate)) for t in turns if t.angle)
            now += math.fsum(duration for _, duration in made) + math.fsum(t.rest for t in turns)
            wait = math.floor(((visit + 1) * (of.own + of.other) - now) / self.grid + _SLACK) * self.grid
            # The others' time is of whole seconds: a fraction would be a reading of its own, soon after the last one.
            left = round(wait - math.floor(wait + _SLACK), 6)
            resting = [k for k, t in enumerate(turns) if t.rest]
            if left > 0.0 and resting:
                k = max(resting, key=lambda k: turns[k].rest)
                turns = (*turns[:k], turns[k]._replace(rest=round(turns[k].rest + left, 6)), *turns[k + 1 :])
                now, wait = now + left, round(wait - left, 6)
            result.append((turns, wait))
            now += wait
            start = start + np.array([sum(t.angle for t in turns if t.axis == k) for k in range(len(start))])
        return result

    def _within(self, axis: int, goal: float) -> float:
        """The nearest pose (deg from the start) in whole steps that an axis reaches."""
        low, high = (math.degrees(float(end - self.limits.start[axis])) for end in self.limits.reach[axis])
        pose = round(goal / _ANGLE) * _ANGLE
        if pose > high:
            return math.floor(high / _ANGLE) * _ANGLE
        return math.ceil(low / _ANGLE) * _ANGLE if pose < low else pose

    def _made(self, axis: int, degrees: float, rate: float) -> tuple[float, float]:
        """Peak rate (deg/s) and duration (s) of a turn in whole steps of the controllers' time: steepest, in the
        nearest number of steps that its limits allow; one near its largest rate, which says most, keeps it."""
        size, grid, most = math.radians(abs(degrees)), self.grid, float(self.limits.rates[axis])
        # θ = A·(duration − ramp), with ramp = steep·A and no flat part at the least.
        steep = 1.0 / float(self.limits.accelerations[axis])
        peaks = (min(w, math.sqrt(size / steep)) for w in (math.radians(rate), most))
        planned, quickest = ((size / w + steep * w) / grid for w in peaks)
        duration = max(round(planned), math.ceil(quickest - _SLACK)) * grid
        if math.radians(rate) >= _FASTEST * most:
            duration = math.ceil(planned - _SLACK) * grid
            return min(rate, math.degrees(min(most, 2.0 * size / duration))), duration
        peak = 2.0 * size / (duration + math.sqrt(max(duration**2 - 4.0 * steep * size, 0.0)))
        peak = math.ceil(math.degrees(peak) / _FINE_RATE - _SLACK) * _FINE_RATE
        return min(peak, math.degrees(most), math.degrees(2.0 * size / duration)), duration

    def moves(self, cycle: Cycle) -> list[dict[str, Any]]:
        """A cycle as a list of moves for a spec."""
        moves: list[dict[str, Any]] = []
        for t in cycle:
            if t.axis >= 0 and t.angle:
                rate, duration = self._made(t.axis, math.degrees(t.angle), math.degrees(t.rate))
                turn = {"turn": f"{math.degrees(t.angle):.10g} deg", "axis": self.axes[t.axis]}
                turn |= {"peak_rate": f"{rate:.8g} deg/s", "duration": f"{duration:.8g} s", "shape": SHAPE}
                moves.append(turn)
            if t.rest:
                moves.append({"rest": f"{t.rest:.6g} s"})
        return moves
