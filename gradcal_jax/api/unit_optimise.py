"""`optimise` for a whole unit: the cycle of poses, moves and rests that minimises the residuals of its requirements."""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from statistics import fmean
from typing import NamedTuple

import numpy as np

from gradcal_jax.api.optimise import BY_HAND, MARGIN
from gradcal_jax.api.posterior_of_plan import UNIT_OF
from gradcal_jax.api.scenarios import scenario_specs
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit, motion_of
from gradcal_jax.api.unit_residual import RequiredQuantity, quantity_of
from gradcal_jax.design.pose_search import CycleItem, PoseCycle, PoseLimits, PoseState, anneal
from gradcal_jax.files.design import ALL, WORST, UnitDesign
from gradcal_jax.files.requirement import UnitRequirement
from gradcal_jax.files.unit_plan import UnitSchedule, UnitStep, quickest_turn, rest_step
from gradcal_jax.files.unit_spec import UnitSpec, unit_spec_of
from gradcal_jax.formulas import repetitions
from gradcal_jax.information import Posterior, repeated_gram, segments_of, unit_system, whiten
from gradcal_jax.model import UnitModel

EVALUATIONS, QUICK_EVALUATIONS = 4000, 400
# Initial temperature of the annealing, in the logarithm of the objective; low, since it begins at a good plan.
WARMEST = 0.01
# Neighbours of a plan that are evaluated in parallel, by as many processes.
TOGETHER = 2
_SEARCH_GRID = 21
# Rounding, as a share of an angle step.
_SLACK = 1e-9
# From this number of cycles, the information of all cycles is computed from three.
_MANY = 6


class UnitOptimum(NamedTuple):
    """An optimised unit spec, with its requirements before and after: `rows` of (name, unit, before, now); None: not
    observable. `gain`: geometric mean of before over now. `kept`: nothing better was found than the spec's own plan,
    which it is."""

    spec: UnitSpec
    rows: tuple[tuple[str, str, float | None, float | None], ...]
    gain: float
    evaluations: int
    kept: bool = False


def optimise_unit(
    spec: UnitSpec,
    *,
    evaluations: int = EVALUATIONS,
    seed: int | None = None,
    warmest: float = WARMEST,
    until_met: bool = False,
    stop: Callable[[], bool] = lambda: False,
    values: Callable[[Sequence[PoseCycle]], Iterable[float]] | None = None,
) -> Iterator[PoseState | UnitOptimum]:
    """Yield the state of the search after every `TOGETHER` evaluations, and the optimum at the end.

    `evaluations`: plans that are tried; `warmest`: see `design.pose_search.anneal`. `until_met`: no further than to a
    plan that meets every target with `MARGIN`. `values`: evaluates `CycleValue` for several cycles, for example in
    several processes; the optimum does not depend on it.

    Errors: `ValueError` where there is no requirement (or, with `until_met`, no target), the table is turned by hand,
    or the plan's turns are no whole numbers of the angle step.
    """
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]] to minimise: add one")
    if spec.rig.table.drive == "hand":
        raise ValueError(BY_HAND)
    value = CycleValue(spec)
    design, limits = value.design, _limits(spec, value.design)
    if until_met and all(r.target is None for r in spec.requirement):
        raise ValueError("to stop when every target is met, give a requirement a target")
    state, judged, seed = None, None, design.seed if seed is None else seed
    # The first plan of the search is slowed down to the gyros' full scale.
    start = tuple(item._replace(rate=min(item.rate, limits.rates[item.axis])) for item in _items(spec, design))
    for state in anneal(
        start,
        values or functools.partial(map, value),
        limits,
        evaluations=evaluations,
        seed=seed,
        warmest=warmest,
        together=TOGETHER,
    ):
        yield state
        if stop():
            break
        if until_met and state.best != judged:
            judged = state.best
            if value.largest_ratio(judged) <= math.log(1.0 - MARGIN):
                break
    assert state is not None
    tables = spec.model_dump(mode="json", exclude_unset=True)
    tables["plan"]["cycle"]["moves"] = value.moves_in_words(state.best)
    optimised = unit_spec_of(tables)
    fine = tuple(quantity_of(value.built, r) for r in spec.requirement)
    before, after = (_statistics(value.known[0] + _gram_of(assemble_unit(s)), fine) for s in (spec, optimised))
    # The search began at the spec's poses with the quickest turns, not at its plan itself, which may be better.
    kept = value.of_statistics(spec.requirement, after) > value.of_statistics(spec.requirement, before)
    optimised, after = (spec, before) if kept else (optimised, after)
    rows = tuple(
        (r.name, UNIT_OF[r.quantity][0], b, a) for r, b, a in zip(spec.requirement, before, after, strict=True)
    )
    ratios = [math.log(b / a) for b, a in zip(before, after, strict=True) if a and b]
    yield UnitOptimum(
        optimised, rows, math.exp(float(np.mean(ratios))) if ratios else 1.0, round(state.share * evaluations),
        kept,
    )  # fmt: skip


class CycleValue:
    """The objective of a cycle: the logarithm of residual over target, on a coarse grid; with `uncertain` noise its
    mean over the scenarios, or the worst."""

    def __init__(self, spec: UnitSpec):
        design = spec.design or UnitDesign()
        coarse = tuple(
            r.model_copy(update={"grid": tuple(min(g, _SEARCH_GRID) for g in r.grid)}) for r in spec.requirement
        )
        self.built, self.schedule, self.design = assemble_unit(spec), spec.plain_schedule, design
        scenarios = scenario_specs(spec)
        self.models = tuple(assemble_unit(one).model if one is not spec else self.built.model for one, _ in scenarios)
        self.over_scenarios = max if design.robust == "worst" else fmean
        self.quantities, self.worst = tuple(quantity_of(self.built, r) for r in coarse), design.minimise == WORST
        own = tuple(q for q in self.quantities if q.requirement.name == design.minimise)
        self.minimised = self.quantities if design.minimise in (ALL, WORST) else own
        rows = self.built.model.prior_rows()
        # The information in each scenario before the plan begins: from priors and motions before it.
        self.known = [rows.T @ rows + self._past(model) for model in self.models]
        # Whether cycles differ only in temperature, which is linear in time; see `information.repeated`.
        self.repeats = (
            len(spec.plain_schedule.stretches) == 1
            and sum(segment.used for segment in spec.plain_schedule.segments) == 1
            and spec.rig.table.standing == "held"
            and spec.sensor.thermal_lag is None
            and not any(np.any(c.model.processes.rate_gain) for c in self.built.model.channels)
            and self.built.model.shifts(np.zeros(1)) is not None
        )

    def _past(self, model: UnitModel) -> np.ndarray:
        built = self.built._replace(model=model)
        nothing = np.zeros((model.size, model.size))
        return sum((_gram_of(built._replace(motion=motion)) for motion in built.past), nothing)

    def __call__(self, cycle: PoseCycle) -> float:
        together = max if self.worst else fmean
        return self.over_scenarios([together(logs) for logs in self._logs(cycle, self.minimised)])

    def largest_ratio(self, cycle: PoseCycle) -> float:
        """The logarithm of the largest residual over its target, over all scenarios."""
        limited = tuple(q for q in self.quantities if q.requirement.target is not None)
        return max(max(logs) for logs in self._logs(cycle, limited))

    def of_statistics(self, requirements: Sequence[UnitRequirement], values: Sequence[float | None]) -> float:
        """The objective of a plan with these statistics of all `requirements`, in the units of `UNIT_OF`, by the first
        scenario."""
        names = {q.requirement.name for q in self.minimised}
        logs = [_log(v, r) for r, v in zip(requirements, values, strict=True) if r.name in names]
        return (max if self.worst else fmean)(logs)

    def _logs(self, cycle: PoseCycle, quantities: tuple[RequiredQuantity, ...]) -> list[list[float]]:
        """The logarithm of the residual, over the target where there is one, in each scenario for each quantity."""
        plan = self.plan(cycle)
        if plan is None:
            return [[math.inf] * len(quantities)]
        of = [q.requirement for q in quantities]
        return [
            [_log(v, r) for v, r in zip(_statistics(known + gram, quantities), of, strict=True)]
            for known, gram in zip(self.known, self._grams(plan), strict=True)
        ]

    def _grams(self, plan: UnitSchedule) -> list[np.ndarray]:
        """The information of a plan's rows in each scenario; of a repeating cycle, from three of its cycles."""
        (stretch, *_), turns = plan.stretches, np.zeros(len(plan.start))
        for step in plan.steps:
            if step.axis >= 0:
                turns[step.axis] += step.move.angle / (2.0 * math.pi)
        returns = np.all(abs(turns - np.round(turns)) < _SLACK)
        few = self._of_three(plan) if self.repeats and returns and stretch.cycles >= _MANY else None
        if few is not None:
            return few
        built = self.built._replace(motion=motion_of(plan, self.built.spec, self.built.model))
        return [_gram_of(built._replace(model=model)) for model in self.models]

    def _of_three(self, plan: UnitSchedule) -> list[np.ndarray] | None:
        """The same from three of its cycles; None where three do not determine all."""
        (stretch,) = plan.stretches
        (segment,) = (s for s in plan.segments if s.used)
        shorter = 3.0 * plan.period + stretch.leftover
        stretch = replace(stretch, start=0.0, duration=shorter, cycles=3)
        warm = segment.temperature_start + segment.slope * shorter
        segment = replace(segment, start=0.0, duration=shorter, temperature_end=warm)
        few = replace(plan, segments=(segment,), stretches=(stretch,))
        built = self.built._replace(motion=motion_of(few, self.built.spec, self.built.model))
        nodes = built.body_nodes()
        rows = int(np.searchsorted(segments_of(built.motion, built.model).row_segment, len(plan.steps)))
        shifts = built.model.shifts(segment.slope * plan.period * np.arange(plan.stretches[0].cycles - 2))
        assert shifts is not None
        grams = []
        for model in self.models:
            steps, columns = unit_system(built.motion, model, nodes)
            grams.append(repeated_gram(steps, columns, rows, shifts, built.points + 1))
            if grams[-1] is None:
                return None
        return grams

    def plan(self, cycle: PoseCycle) -> UnitSchedule | None:
        """The whole plan of a cycle; None where it does not fit."""
        axes, steps = self.built.spec.rig.table.axis, []
        for k, item in enumerate(cycle):
            if item.steps:
                angle = item.steps * float(self.design.angle_step)
                steps.append(UnitStep(item.axis, quickest_turn(angle, axes[item.axis], math.radians(item.rate)), k))
            if item.rest:
                steps.append(rest_step(item.rest, k))
        period = math.fsum(s.move.duration for s in steps)
        stretches = []
        for stretch in self.schedule.stretches:
            cycles, left = repetitions(stretch.duration, period, period)
            if not cycles:
                return None
            stretches.append(replace(stretch, cycles=cycles, leftover=left))
        return replace(self.schedule, stretches=tuple(stretches), steps=tuple(steps))

    def moves_in_words(self, cycle: PoseCycle) -> list[dict[str, str]]:
        """The cycle as a list of moves for a spec."""
        axes, moves = self.built.spec.rig.table.axis, []
        for item in cycle:
            if item.steps:
                angle = item.steps * math.degrees(float(self.design.angle_step))
                moves.append(
                    {"turn": f"{angle:g} deg", "axis": axes[item.axis].name, "peak_rate": f"{item.rate:g} deg/s"}
                )
            if item.rest:
                moves.append({"rest": f"{item.rest:g} s"})
        return moves


def _log(value: float | None, requirement: UnitRequirement) -> float:
    """The logarithm of a statistic in the unit of `UNIT_OF`, over the target where there is one."""
    target = requirement.target
    limit = 1.0 if target is None else float(target) * UNIT_OF[requirement.quantity][1]
    return math.log(value / limit) if value else math.inf


def _gram_of(built: AssembledUnit) -> np.ndarray:
    """The information (Gram matrix) of the whitened rows of a plan."""
    rows = whiten(*unit_system(built.motion, built.model, built.body_nodes()))
    return rows.T @ rows


def _statistics(gram: np.ndarray, quantities: tuple[RequiredQuantity, ...]) -> list[float | None]:
    """Every requirement's statistic in the units of `UNIT_OF`, from the Gram matrix: its scaled columns are
    far from parallel where everything is observable."""
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(gram / (scale[:, None] * scale[None, :]))
    seen = values > 1e-13 * values[-1]
    known = Posterior(vectors[:, seen] / np.sqrt(values[seen]) / scale[:, None], vectors[:, ~seen] / scale[:, None])
    return [q.residual(known).statistic() for q in quantities]


def _limits(spec: UnitSpec, design: UnitDesign) -> PoseLimits:
    step, axes = float(design.angle_step), spec.rig.table.axis
    per_turn = 2.0 * math.pi / step
    if abs(per_turn - round(per_turn)) > 1e-6:
        raise ValueError(
            f"design.angle_step = {design.angle_step}: a turn must be a whole number of steps, such as 45 deg"
        )
    gyro = spec.sensor.gyro
    usable = math.inf if gyro is None or gyro.usable_rate is None else gyro.usable_rate
    return PoseLimits(
        round(per_turn),
        tuple(math.floor(math.degrees(min(float(a.max_rate), usable)) * 10.0) / 10.0 for a in axes),
        tuple((a.reach[0] / step - _SLACK, a.reach[1] / step + _SLACK) for a in axes),
        float(design.shortest_rest),
        float(design.longest_rest),
        design.moves,
    )


def _items(spec: UnitSpec, design: UnitDesign) -> PoseCycle:
    """The spec's own cycle, as the start of the search."""
    step, items = float(design.angle_step), []
    for s in spec.plain_schedule.steps:
        for _ in range(s.move.repeat):
            if s.axis < 0:
                rest = round(s.move.duration, 1)
                if items and not items[-1].rest:
                    items[-1] = items[-1]._replace(rest=rest)
                else:
                    items.append(CycleItem(0, 0, math.degrees(float(spec.rig.table.axis[0].max_rate)), rest))
                continue
            count = s.move.angle / step
            if abs(count - round(count)) > 1e-6:
                raise ValueError(
                    f"the plan turns by {math.degrees(s.move.angle):.6g} deg, which is no whole number of "
                    f"design.angle_step, {design.angle_step}: change one of them"
                )
            items.append(CycleItem(s.axis, round(count), round(math.degrees(s.move.fastest), 1), 0.0))
    return tuple(items)
