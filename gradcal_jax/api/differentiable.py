"""A spec's requirements as a pure function of its figures, for optimisation outside this package with JAX."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.cycle_plan import CyclePlan
from gradcal_jax.api.measure import criterion_of
from gradcal_jax.api.systematic import counted_criterion
from gradcal_jax.api.verdicts import UNIT_OF
from gradcal_jax.arrays import AnyArray, namespace, put
from gradcal_jax.design import Criterion
from gradcal_jax.display import summary
from gradcal_jax.files.changes import changed
from gradcal_jax.files.spec import expect_spec, goes_on
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import information
from gradcal_jax.model import SensorModel
from gradcal_jax.trajectory import Rule, Schedule, rule_of

_LAG = "thermal lag"
# The noise figures that every model has, by error source.
FIGURES = {
    "angle random walk": lambda m: m.angle_random_walk,
    "rate accuracy": lambda m: m.reference.rate_accuracy,
    "reading noise": lambda m: m.reference.reading_noise,
    "standstill offset": lambda m: m.reference.standstill_offset,
    "timing error": lambda m: m.reference.timing_error,
}
# Fields of the moves and of the programme's stretches, and whether a field belongs to the moves.
_PLAN = {
    "move durations": (lambda s: s.duration, True),
    "peak rates": (lambda s: s.peak_rate, True),
    "speed-up times": (lambda s: s.ramp, True),
    "chamber durations": (lambda s: s.programme.durations, False),
    "chamber slopes": (lambda s: s.programme.slopes, False),
    "chamber steps": (lambda s: s.programme.jumps, False),
    "first temperature": (lambda s: s.programme.start, False),
}


class Differentiable(eqx.Module):
    """Every requirement's residual as a pure function of `quantities`, for `jax.grad`, `vmap`, `jit` and libraries that
    use them. A pytree.

    `quantities`: the spec's own figures by name, SI (°C, K/s for the chamber): numbers of the sensor and the rig, `()`
    or one for each such error, `(k,)`; of each move of the plan's cycle, `(m,)`; of each stretch of the chamber's
    programme, `(s,)`, with the step (K) at its beginning. Changed times must leave room for the moves; rests that fill
    a stretch follow.
    """

    quantities: dict[str, np.ndarray]
    _model: SensorModel
    _schedule: Schedule
    _criteria: dict[str, Criterion]
    _factors: dict[str, float]
    _sources: dict[str, tuple[int, ...]] = eqx.field(static=True)
    _moves: tuple[int, ...] = eqx.field(static=True)
    _rule: Rule = eqx.field(static=True)

    __repr__ = summary

    def __call__(self, quantities: Mapping[str, Any]) -> dict[str, Float[AnyArray, ""]]:
        """Residuals in ppm or deg/h, by requirement; quantities that are absent have the spec's values.

        Errors: `ValueError` for a name that the spec does not have.
        """
        if unknown := set(quantities) - set(self.quantities):
            raise ValueError(f"the spec has no {sorted(unknown)[0]!r}: it has {', '.join(self.quantities)}")
        figures: dict[str, Any] = {**self.quantities, **quantities}
        schedule, model = self._planned(figures), self._sensed(figures)
        xp = namespace(*figures.values())
        if xp is jnp:
            # NumPy arrays cannot hold traced values; integer arrays (which pieces there are) stay concrete.
            traced = lambda x: jnp.asarray(x) if eqx.is_inexact_array(x) else x  # noqa: E731
            schedule, model = jax.tree.map(traced, (schedule, model))
        info = information(schedule.trajectory(figures.get(_LAG)), model, self._rule)
        return {name: xp.asarray(c(info) * self._factors[name]) for name, c in self._criteria.items()}

    def _planned(self, figures: Mapping[str, Any]) -> Schedule:
        schedule, moves = self._schedule, np.array(self._moves)
        for name, (field, of_moves) in _PLAN.items():
            if name in figures:
                whole = put(field(schedule), moves, figures[name]) if of_moves else figures[name]
                schedule = eqx.tree_at(field, schedule, whole)
        return schedule

    def _sensed(self, figures: Mapping[str, Any]) -> SensorModel:
        model = self._model
        for name, field in FIGURES.items():
            if name in figures:
                model = eqx.tree_at(field, model, figures[name])
        for name, members in self._sources.items():
            initial, driving = model.processes.initial_std, model.processes.diffusion
            at = np.array(members)
            share = figures[name] / self.quantities[name]
            changed = put(initial, at, initial[at] * share), put(driving, at, driving[at] * share)
            model = eqx.tree_at(lambda m: (m.processes.initial_std, m.processes.diffusion), model, changed)
        return model


class DifferentiableCycle(eqx.Module):
    """Every requirement's residual of an IMU as a pure function of its cycle's numbers, as a `Differentiable`.

    `quantities`, `(m,)` for the turns of the cycle in order: "turns" rad, "peak rates" rad/s, "rests" s after each turn
    (0: none). Turns are trapezoids as steep as the axes allow; rests are scaled to fill the cycle's time, which is
    fixed, as are the number of cycles and the chamber's course. Every cycle begins at the same pose: the turns of each
    axis should sum to whole ones.
    """

    quantities: dict[str, np.ndarray]
    _plan: CyclePlan = eqx.field(static=True)

    __repr__ = summary

    def __call__(self, quantities: Mapping[str, Any]) -> dict[str, Float[AnyArray, ""]]:
        """Residuals in the units of `predict`, by requirement: the statistic that its target limits, else its own.

        Errors: `ValueError` for a name that there is not.
        """
        if unknown := set(quantities) - set(self.quantities):
            raise ValueError(f"the spec has no {sorted(unknown)[0]!r}: it has {', '.join(self.quantities)}")
        numbers = (jnp.asarray(quantities.get(name, own)) for name, own in self.quantities.items())
        return self._plan.left_by(*numbers)


def differentiable(spec: Spec) -> Differentiable | DifferentiableCycle:
    """A spec's requirements as a pure function of figures. Of one gyro along the only axis of a table those of the
    sensor, the rig and the plan: at the spec's own `quantities` it equals `predict`, in ppm or deg/h, by the quadrature
    rule of the spec's plan. Of any other IMU those of its cycle, within about a per cent of `predict`.

    Needs float64 (`jax_enable_x64`). Errors: `ValueError` for a spec without requirements, and for an IMU whose table
    stands.
    """
    spec = expect_spec(spec)
    if spec.done:
        raise goes_on("a function of the plan's figures")
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there is no result to compute: add one")
    if not spec.turns_one_gyro:
        plan = CyclePlan(changed(spec, {"design": None}))
        if not plan.turns_free:
            raise ValueError("the table does not move, so there is no cycle to change")
        angle, rate, rest = (np.array(x, dtype=float) for x in list(zip(*plan.start.turns, strict=True))[1:])
        return DifferentiableCycle({"turns": angle, "peak rates": rate, "rests": rest}, plan)
    built = assemble(spec)
    schedule = built.schedule
    moves = np.setdiff1d(np.arange(len(schedule.duration)), schedule.fill_move)
    return Differentiable(
        _figures(built, schedule, moves),
        built.model,
        schedule,
        {r.name: counted_criterion(criterion_of(built.model, r), built) for r in spec.requirement},
        {r.name: UNIT_OF[r.quantity][1] for r in spec.requirement},
        built.sources,
        tuple(int(k) for k in moves),
        rule_of(built.model, schedule.trajectory(built.thermal_lag)),
    )


def _figures(built: Assembled, schedule: Schedule, moves: np.ndarray) -> dict[str, np.ndarray]:
    model, processes = built.model, built.model.processes
    figures: dict[str, AnyArray] = {n: of(model) for n, of in FIGURES.items() if np.asarray(of(model)).any()}
    for name, members in built.sources.items():
        at = np.array(members)
        walks = processes.initial_std[at] == 0.0
        figures[name] = np.where(walks, processes.diffusion[at], processes.initial_std[at])
    if built.thermal_lag is not None:
        figures[_LAG] = np.asarray(built.thermal_lag)
    figures |= {name: field(schedule)[moves] if own else field(schedule) for name, (field, own) in _PLAN.items()}
    return {name: np.array(value, dtype=float) for name, value in figures.items()}
