"""A spec's requirements as a pure function of its figures, for `jax.grad`, `vmap`, `jit` and libraries that use them.

It is the computation of `predict` with other numbers. What is discrete is that of the spec's own plan: which pieces
there are, which of them are read, where they are divided, and on how many nodes each is integrated.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace, put
from gradcal_jax.information.figures import installation_figures, noise_figures, with_ratios
from gradcal_jax.information.imu_rows import segments_of
from gradcal_jax.information.plan_information import plan_information
from gradcal_jax.information.residual import Residual, residual_of
from gradcal_jax.information.unseen import answers_of, drifting_terms, unseen_columns
from gradcal_jax.model import BSpline, ImuModel, Map, Term
from gradcal_jax.model.build import BuiltImu, build_imu, unweighted_estimator
from gradcal_jax.motion import Schedule, TableMotion
from gradcal_jax.motion.plan_motion import plan_schedule
from gradcal_jax.spec.requirement import QUANTITIES
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary

LAG: Final = "thermal lag"
READING_INTERVALS: Final = "intervals of readings"
MOVE_DURATIONS: Final = "move durations"
PEAK_RATES: Final = "peak rates"
RAMPS: Final = "speed-up times"
CHAMBER_DURATIONS: Final = "chamber durations"
CHAMBER_SLOPES: Final = "chamber slopes"
# Nodes of a motion at most for which every piece has nodes of its own; of more, pieces that are alike share theirs.
_MOST_NODES = 100_000
# Fields of the moves and of the programme's stretches, and whether a field belongs to the moves.
_PLAN: dict[str, tuple[Callable[[Schedule], Any], bool]] = {
    MOVE_DURATIONS: (lambda s: s.duration, True),
    PEAK_RATES: (lambda s: s.peak_rate, True),
    RAMPS: (lambda s: s.ramp, True),
    CHAMBER_DURATIONS: (lambda s: s.programme.durations, False),
    CHAMBER_SLOPES: (lambda s: s.programme.slopes, False),
    "chamber steps": (lambda s: s.programme.jumps, False),
    "first temperature": (lambda s: s.programme.start, False),
}


@dataclass(frozen=True)
class Differentiable:
    """Every requirement's residual as a pure function of `quantities`.

    `quantities`: the spec's own figures by name, SI (°C, K/s for the chamber): numbers of the sensor and the rig, `()`
    or one for each such error or axis, `(k,)`, where zero stays zero; of each move of the plan's cycle, `(m,)`; of each
    stretch of the chamber's programme, `(s,)`, with the step (K) at its beginning. Changed times must leave room for
    the moves; rests that fill a stretch follow. In a plan of many long cycles, every cycle must begin at the same pose:
    there the turns of each axis should sum to whole ones. Where bins over rate or temperature jump, the figures that
    move the plan across their edges have no slope here, and are left out.
    """

    quantities: dict[str, np.ndarray]
    own: dict[str, np.ndarray]
    built: BuiltImu
    _schedule: Schedule
    _moves: np.ndarray
    _terms: list[tuple[int, Term]]
    _required: dict[str, Residual]

    __repr__ = summary

    def __call__(self, quantities: Mapping[str, Any]) -> dict[str, Float[AnyArray, ""]]:
        """Residuals in the units of `predict`, by requirement: the statistic that its verdict judges, with what the
        spec names. Quantities that are absent have the spec's values.

        Errors: `ValueError` for a name that the spec does not have, or that has no slope.
        """
        unknown = [name for name in quantities if name not in self.quantities]
        if unknown and unknown[0] in self.own:
            raise ValueError(
                f"{unknown[0]!r} moves the plan across the edges of bins, where it has no slope: give the map a "
                "polynomial or a spline in place of bins"
            )
        if unknown:
            raise ValueError(f"the spec has no {unknown[0]!r}: it has {', '.join(self.quantities)}")
        return self.at(quantities)

    def at(self, quantities: Mapping[str, Any]) -> dict[str, Float[AnyArray, ""]]:
        """The same for any figures of `own`, as far as the plan keeps its places between the edges of bins."""
        figures: dict[str, Any] = {**self.own, **quantities}
        schedule, model = self._planned(figures), self._sensed(figures)
        xp = namespace(*figures.values())
        if xp is jnp:
            # NumPy arrays cannot hold traced values; integer arrays (which pieces there are) stay concrete.
            traced = lambda x: jnp.asarray(x) if eqx.is_inexact_array(x) else x  # noqa: E731
            schedule = jax.tree.map(traced, schedule)
        motion = self._moved(schedule, figures.get(LAG))
        at = segments_of(self.built.motion, self.built.model)
        info, columns = plan_information(self.built._replace(motion=motion, model=model), self._terms, at)
        root, results = info.root(), dict[str, Any]()
        unseen = unseen_columns(self.built, answers_of(self.built, columns if self._terms else None))
        for name, of in self._required.items():
            value = of._replace(unseen=tuple(unseen.values()))(root)
            results[name] = xp.asarray(value * QUANTITIES[of.requirement.quantity].factor)
        return results

    def _moved(self, schedule: Schedule, lag: Any) -> TableMotion:
        """The motion of a plan, with the divisions of the spec's own one."""
        line, own = schedule.trajectory(lag), self.built.motion
        for pieces, at in own.divisions:
            line, _ = line.divided(pieces, at)
        return replace(own, line=line)

    def _planned(self, figures: Mapping[str, Any]) -> Schedule:
        schedule = self._schedule
        for name, (field, of_moves) in _PLAN.items():
            whole = put(field(schedule), self._moves, figures[name]) if of_moves else figures[name]
            schedule = eqx.tree_at(field, schedule, whole)
        return schedule

    def _sensed(self, figures: Mapping[str, Any]) -> ImuModel:
        places, ratios = noise_figures(self.built.model) | installation_figures(self.built.model), dict[str, Any]()
        for name in places:
            own = self.own[name]
            ratios[name] = namespace(figures[name]).where(own != 0.0, figures[name] / np.where(own, own, 1.0), 1.0)
        model = with_ratios(self.built.model, places, ratios)
        every = model.encoder.every
        if READING_INTERVALS in figures:
            every = put(every, np.flatnonzero(np.isfinite(every)), figures[READING_INTERVALS])
        return replace(model, encoder=replace(model.encoder, every=every))


def differentiable(spec: Spec) -> Differentiable:
    """A spec's requirements as a pure function of figures of the sensor, the rig and the plan: at the spec's own
    `quantities` it equals `predict`, in the same units.

    Needs float64 (`jax_enable_x64`). Errors: `ValueError` for a spec without requirements, and for an estimator that
    does not weight by the noise.
    """
    spec = expect_spec(spec)
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there is no result to compute: add a requirement")
    if unweighted_estimator(spec):
        raise ValueError(
            'estimator = "least squares" is not a function that can be differentiated: use estimator = "best linear"'
        )
    built, schedule = build_imu(spec), plan_schedule(spec)
    moves = np.setdiff1d(np.arange(len(schedule.duration)), schedule.fill_move)
    built = built._replace(motion=_on_own_nodes(built.motion, schedule))
    required = {requirement.name: residual_of(built, requirement) for requirement in spec.requirement}
    own, moving = _figures(built, schedule, moves), _across_edges(built.model)
    quantities = {name: value for name, value in own.items() if name not in moving}
    return Differentiable(quantities, own, built, schedule, moves, drifting_terms(built), required)


def _across_edges(model: ImuModel) -> set[str]:
    """The figures that move a plan across the edges of bins."""
    maps = [term for term in model.terms if isinstance(term, Map)]
    jumps = lambda basis: isinstance(basis, BSpline) and basis.degree == 0 and bool(basis.breaks)  # noqa: E731
    if any(jumps(of.temperature) for of in maps):
        return {*_PLAN, LAG}
    return {PEAK_RATES} if any(jumps(of.rate) for of in maps) else set()


def _on_own_nodes(motion: TableMotion, schedule: Schedule) -> TableMotion:
    """The motion with kinds of pieces that stay alike where the numbers of the moves change one by one."""
    own = motion.nodes[motion.kind]
    if int(np.sum(own)) <= _MOST_NODES:
        each = np.arange(len(motion.kind))
        return replace(motion, kind=each, example=each, nodes=own)
    source = np.arange(schedule.piece_count)
    line = schedule.trajectory()
    for pieces, at in motion.divisions:
        line, of = line.divided(pieces, at)
        source = source[of]
    both = np.stack([motion.kind, np.asarray(schedule.pieces.move)[source]])
    _, example, kind = np.unique(both, axis=1, return_index=True, return_inverse=True)
    return replace(motion, kind=np.reshape(kind, -1), example=example, nodes=motion.nodes[motion.kind[example]])


def _figures(built: BuiltImu, schedule: Schedule, moves: np.ndarray) -> dict[str, np.ndarray]:
    """The spec's own quantities."""
    noise = noise_figures(built.model) | installation_figures(built.model)
    figures: dict[str, Any] = {name: of.value for name, of in noise.items()}
    every = np.asarray(built.model.encoder.every)
    if np.any(np.isfinite(every)):
        figures[READING_INTERVALS] = every[np.isfinite(every)]
    if built.spec.sensor.lag is not None:
        figures[LAG] = built.spec.sensor.lag
    figures |= {name: field(schedule)[moves] if own else field(schedule) for name, (field, own) in _PLAN.items()}
    return {name: np.array(value, dtype=float) for name, value in figures.items()}
