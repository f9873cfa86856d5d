"""Free coordinates: any real vector decodes to a cycle that the table executes, and a ramp that the chamber follows.

| what | from free numbers | why it is feasible |
|---|---|---|
| durations of the moves of a turn at the table | least times + what is left · softmax | they fill that time exactly |
| peak rate of a turn | cap · tanh | cap: the table's rate, the sensor's full scale, and what acceleration allows in
the turn's time | | ramp time | least + (half the turn − least) · sigmoid | least: what the acceleration needs at that
rate | | temperature steps, cycle by cycle | uniform mixed with softmax | the mixture stops where the steepest step
meets the chamber's slope |

The axis has its *turns at the table*, `own_time` each, with `other_time` standing after each for the other axes; a
cycle is one or more of them, with moves of their own (a reading at rest costs time only between the moves of one turn
at the table, so few long moves in each, others in the next, are better than all in each).

With limited travel the turns in the direction that prevails are scaled down until a cycle ends where it began, then all
of them until the largest excursion fits: scaling down keeps every other limit.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax import formulas
from gradcal_jax.formulas import RAMPED_SHAPES
from gradcal_jax.plans import GradientPlan, Move, Programme
from gradcal_jax.plans.motion import Division
from gradcal_jax.plans.plan import Stretch

# Peak acceleration over (peak rate / time), the time being the ramp's, or the whole move's for shapes without ramps.
_STEEPNESS = {"cosine ramps": np.pi / 2.0, "linear ramps": 1.0, "half sine": np.pi, "raised cosine": np.pi}
SEARCHED_SHAPES = tuple(_STEEPNESS)

# A rest is searched with this many pieces; each one's reading stands for all that fall into it.
_PIECES_A_REST = 2
_PIECES_OF_OTHERS = 8


class Element(NamedTuple):
    """One move of the cycle, as structure: a rest (`shape="rest"`) or a turn, and the least time it may take (s).

    `group` counts the cycle's turns at the table.
    """

    shape: str
    least: float
    group: int = 0


class Limits(NamedTuple):
    """What rig and sensor allow: rad/s, rad/s², rad each way (`inf`: unlimited), K/s."""

    max_rate: float
    max_acceleration: float
    travel: float = np.inf
    max_slope: float = np.inf


class Cycle(NamedTuple):
    """A decoded cycle: durations (s), signed peak rates (rad/s), ramp times (s) of its moves; temperature steps (K)."""

    durations: Float[Array, " k"]
    peak_rates: Float[Array, " k"]
    ramps: Float[Array, " k"]
    steps: Float[Array, " c"]


class Coordinates(eqx.Module):
    """The plans that one structure of cycle allows, over an unbounded vector of `size` numbers.

    `own_time`, `other_time`: of each turn at the table; s. `cycles`: how often the cycle is made. `motion_time`: the
    whole ramp's. `temperature_start`, `temperature_end` °C. `read_every` s, at rest. Free: which of "duration",
    "rest", "peak_rate", "ramp", "gradient" may change; what may not stays as in `nominal`.
    """

    elements: tuple[Element, ...] = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    own_time: float = eqx.field(static=True)
    other_time: float = eqx.field(static=True)
    others_read: bool = eqx.field(static=True)
    motion_time: float = eqx.field(static=True)
    cycles: int = eqx.field(static=True)
    temperature_start: float = eqx.field(static=True)
    temperature_end: float = eqx.field(static=True)
    read_every: float = eqx.field(static=True)
    free: frozenset[str] = eqx.field(static=True)
    nominal: Cycle
    axis: str = eqx.field(static=True, default="x")

    def __check_init__(self):
        if [e.group for e in self.elements] != sorted(e.group for e in self.elements):
            raise ValueError("the moves of a cycle must be in the order of its turns at the table")
        for group in range(self.groups):
            least = sum(e.least for e in self.elements if e.group == group)
            if least > self.own_time * (1.0 + 1e-9):
                raise ValueError(
                    f"the moves need at least {least:.4g} s but the axis has {self.own_time:.4g} s in each cycle: "
                    "take fewer moves or a longer cycle"
                )
        slope = abs(self.temperature_end - self.temperature_start) / self.motion_time
        if slope > self.limits.max_slope * (1.0 + 1e-9):
            raise ValueError(
                f"the ramp needs {slope * 60:.4g} K/min but the chamber manages "
                f"{self.limits.max_slope * 60:.4g} K/min: give it more time, or a smaller range"
            )

    @property
    def groups(self) -> int:
        """Turns at the table in a cycle."""
        return self.elements[-1].group + 1

    @property
    def period(self) -> float:
        """Of a cycle, s."""
        return self.groups * (self.own_time + self.other_time)

    @property
    def _turns(self) -> np.ndarray:
        return np.array([i for i, e in enumerate(self.elements) if e.shape != "rest"], dtype=int)

    @property
    def _ramped(self) -> np.ndarray:
        return np.array([i for i, e in enumerate(self.elements) if e.shape in RAMPED_SHAPES], dtype=int)

    @property
    def _sizes(self) -> tuple[int, int, int, int]:
        timed = len(self.elements) if self.free & {"duration", "rest"} else 0
        return (
            timed,
            len(self._turns) if "peak_rate" in self.free else 0,
            len(self._ramped) if "ramp" in self.free else 0,
            len(self.nominal.steps) if "gradient" in self.free else 0,
        )

    @property
    def size(self) -> int:
        """How many free numbers there are."""
        return sum(self._sizes)

    def cycle(self, z: Float[Array, " size"]) -> Cycle:
        """Decode: see the table at the module's head."""
        timed, turns, ramps, steps = jnp.split(z, np.cumsum(self._sizes)[:-1])
        decoded = self._rates(self._durations(timed), turns, ramps)
        return self._within_travel(decoded)._replace(steps=self._steps(steps))

    def _durations(self, z: Array) -> Array:
        if not z.shape[0]:
            return self.nominal.durations
        parts = []
        for group in range(self.groups):
            members = np.array([i for i, e in enumerate(self.elements) if e.group == group])
            least = np.array([self.elements[i].least for i in members])
            parts.append(least + (self.own_time - np.sum(least)) * jax.nn.softmax(z[members]))
        return jnp.concatenate(parts)

    def _rates(self, durations: Array, z_rates: Array, z_ramps: Array) -> Cycle:
        limits = self.limits
        peak, ramp = self.nominal.peak_rates, self.nominal.ramps
        turns, ramped = self._turns, self._ramped
        steep = np.array([_STEEPNESS.get(e.shape, 0.0) for e in self.elements])
        time = jnp.where(np.isin(np.arange(len(self.elements)), ramped), 0.5, 1.0) * durations
        cap = jnp.minimum(limits.max_rate, limits.max_acceleration * time / np.where(steep > 0.0, steep, 1.0))
        free = peak.at[turns].set(cap[turns] * jnp.tanh(z_rates)) if z_rates.shape[0] else peak
        peak = jnp.clip(free, -cap, cap)
        least = steep * jnp.abs(peak) / limits.max_acceleration
        if z_ramps.shape[0]:
            room = 0.5 * durations[ramped] - least[ramped]
            ramp = ramp.at[ramped].set(least[ramped] + room * jax.nn.sigmoid(z_ramps))
        else:
            ramp = jnp.clip(ramp, least, 0.5 * durations)
        return Cycle(durations, peak, ramp, self.nominal.steps)

    def _steps(self, z: Array) -> Array:
        if not z.shape[0]:
            return self.nominal.steps
        span = self.temperature_end - self.temperature_start
        even = jnp.full(z.shape, span / len(z))
        uneven = span * jax.nn.softmax(z)
        steepest = self.limits.max_slope * self.motion_time / len(z)
        over = jnp.abs(uneven) - jnp.abs(even)
        room = jnp.where(over > 0.0, (steepest - jnp.abs(even)) / jnp.where(over > 0.0, over, 1.0), jnp.inf)
        mix = jnp.minimum(1.0, jnp.min(room))
        return even + mix * (uneven - even)

    def _within_travel(self, cycle: Cycle) -> Cycle:
        if not np.isfinite(self.limits.travel) or not len(self._turns):
            return cycle
        angles = jnp.stack([self._angle(cycle, int(i)) for i in self._turns])
        there, back = jnp.sum(jnp.maximum(angles, 0.0)), jnp.sum(jnp.maximum(-angles, 0.0))
        share = lambda a, b: jnp.minimum(1.0, b / jnp.where(a > 0.0, a, 1.0))  # noqa: E731
        factor = jnp.where(angles > 0.0, share(there, back), share(back, there))
        excursion = jnp.max(jnp.abs(jnp.cumsum(angles * factor)))
        factor = factor * jnp.minimum(1.0, self.limits.travel / jnp.where(excursion > 0.0, excursion, 1.0))
        return cycle._replace(peak_rates=cycle.peak_rates.at[self._turns].multiply(factor))

    def _angle(self, cycle: Cycle, i: int) -> Array:
        return formulas.turned_angle(self.elements[i].shape, cycle.peak_rates[i], cycle.durations[i], cycle.ramps[i])

    def plan(self, cycle: Cycle) -> GradientPlan:
        """The plan of a decoded cycle, its rests relaxed: readings by their share, not by whole numbers."""
        spacing = jnp.asarray(self.read_every)
        others = _even(_PIECES_OF_OTHERS, self.others_read)
        standing = (_rest(jnp.asarray(self.other_time), others, spacing, self.axis),) if self.other_time > 0.0 else ()
        moves: list[Move] = []
        for i, element in enumerate(self.elements):
            if i and element.group != self.elements[i - 1].group:
                moves += standing
            moves.append(self._move(element, cycle, i, spacing))
        if "gradient" in self.free:
            stretch = self.motion_time / len(cycle.steps)
            durations, slopes = jnp.full(cycle.steps.shape, stretch), cycle.steps / stretch
        else:
            span = self.temperature_end - self.temperature_start
            durations, slopes = jnp.array([self.motion_time]), jnp.array([span / self.motion_time])
        programme = Programme(jnp.asarray(self.temperature_start), durations, slopes)
        left = self.motion_time - self.cycles * self.period + self.other_time
        tail = others if left > 1e-6 else None
        return GradientPlan(
            programme,
            tuple(moves),
            standing,
            (Stretch(0, durations.shape[0], self.cycles, tail),),
            tail_spacing=spacing,
        )

    def _move(self, element: Element, cycle: Cycle, i: int, spacing: Array) -> Move:
        if element.shape == "rest":
            return _rest(cycle.durations[i], _even(_PIECES_A_REST, True), spacing, self.axis)
        unread, whole = Division((0.0, 1.0), (False,)), Division((0.0, 1.0), (True,))
        parts = len(formulas.shape_pieces(element.shape))
        return Move(
            cycle.peak_rates[i],
            cycle.durations[i],
            cycle.ramps[i],
            jnp.zeros(0),
            jnp.zeros(()),
            shape=element.shape,
            axis=self.axis,
            cycles=1,
            divisions=(unread,) * (parts - 1) + (whole,),
            division_at_rest=whole,
        )


def _even(count: int, read: bool) -> Division:
    return Division(tuple(float(k) / count for k in range(count + 1)), (read,) * count)


def _rest(duration: Array, division: Division, spacing: Array, axis: str) -> Move:
    zero = jnp.zeros(())
    return Move(
        zero, duration, zero, jnp.zeros(0), zero, "rest", axis, 1, (division,), division, spacing=spacing
    )  # fmt: skip
