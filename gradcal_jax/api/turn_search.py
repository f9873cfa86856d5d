"""The search for the course of one gyro's turns, of the chamber, or of set points, that minimises a [design]'s
objective; its result is rounded, with the limits that bind it."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.api.build import assemble
from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.fixture import hung_alike, known_together
from gradcal_jax.api.imu_build import build_imu, imu_posterior
from gradcal_jax.api.imu_residual import ImuResidual, imu_residual
from gradcal_jax.api.measure import Measure, design_of, measure
from gradcal_jax.api.plan_to_spec import plan_to_spec
from gradcal_jax.api.scenarios import scenario_specs
from gradcal_jax.api.search_results import (
    MARGIN,
    MET,
    NO_TARGET,
    Optimised,
    Price,
    RequirementChange,
    SearchStep,
    priced,
)
from gradcal_jax.api.structures import Structure, structures
from gradcal_jax.api.systematic import own_of_imu
from gradcal_jax.api.verdicts import UNIT_OF, limit_of
from gradcal_jax.design import (
    KEPT,
    AnyCoordinates,
    Compiled,
    Coordinates,
    Optimum,
    ProgrammeCoordinates,
    ProgrammeKnots,
    SearchState,
    exactly,
    missed_limit,
    multipliers,
    polish,
    search,
)
from gradcal_jax.files import SpecError
from gradcal_jax.files.rounding import rounded, steps_of
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information.residual import Statistic

STEPS: Final = 240
# A turn within this share of its limit counts as limited.
_AT_LIMIT: Final = 1e-3
_FIRST: Final = 100
_POLISH: Final = 1000
_POLISHES: Final = 3
_BRIEF_POLISH: Final = 40
# The largest relative increase of the objective for which vanished turns are left out.
_NO_WORSE: Final = 1e-3
# A larger relative cost of rounding is reported.
_DEAR: Final = 0.05
# Number of random steps from the best programme, and their sizes (shares of the time, of the chamber's range).
_HOPS: Final = 80
_HOP_STEPS: Final = (0.05, 0.1, 0.2, 0.4)


class _Checkpoint(NamedTuple):
    """The state of a search for resuming it: the current structure and its state, and the best ones so far."""

    structure: int
    state: SearchState
    best_structure: int
    best: SearchState

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays by name."""
        arrays = {"at": np.array([self.structure, self.best_structure])}
        for name, state in (("state", self.state), ("best", self.best)):
            arrays |= {f"{name}_{field}": np.asarray(entry) for field, entry in state._asdict().items()}
        return arrays

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "_Checkpoint":
        """From such arrays."""
        states: list[SearchState] = []
        for name in ("state", "best"):
            of = {field: arrays[f"{name}_{field}"] for field in SearchState._fields}
            numbers = int(of["step"]), float(of["first"]), float(of["best"])
            states.append(SearchState(of["points"], of["values"], *numbers, of["best_point"]))
        structure, best = (int(k) for k in arrays["at"])
        return cls(structure, states[0], best, states[1])


def belief_of(spec: Spec) -> str:
    """A sentence on the maps that a design takes as exact; empty where each has a discrepancy or smoothness."""
    gyro = spec.sensor.gyro
    sections = {} if gyro is None else {"bias": gyro.bias, "scale factor": gyro.scale_factor}
    sure = [name for name, s in sections.items() if s is not None and s.discrepancy is None and s.smoothness is None]
    if not sure:
        return ""
    return (
        f"assumed: the {' and the '.join(sure)} {'have' if len(sure) > 1 else 'has'} exactly the structure in the "
        "spec; a discrepancy in the spec allows deviations from it, and gives a plan that is robust against them"
    )


def exact(spec: Spec, of: Measure) -> float:
    """The exact value of a spec's own plan, on the requirement's own grid; `inf` where it observes too little."""
    wanted = [r for r in spec.requirement if r.name == design_of(spec).minimise]
    if wanted and len(of.cases) == 1:
        return residuals_of_plan(spec)[wanted[0].name].finite_statistic()
    value = of.exact(assemble(spec).schedule)
    return value if np.isfinite(value) else np.inf


def residuals_of_plan(spec: Spec) -> dict[str, ImuResidual]:
    """What a spec's own plan leaves of every requirement, by the terms that the spec names; of a fixture by an estimate
    of all IMUs together, where that is worst."""
    hung = hung_alike(spec)
    builts = [build_imu(at) for at, _ in hung]
    known, _ = known_together(builts, [imu_posterior(b) for b in builts], [len(names) for _, names in hung])
    own = [own_of_imu(*of) for of in zip(builts, known, strict=True)]
    return {
        r.name: max((imu_residual(*of, r) for of in zip(builts, own, strict=True)), key=ImuResidual.finite_statistic)
        for r in spec.requirement
    }


def requirement_changes(spec: Spec, plan: Spec) -> tuple[RequirementChange, ...]:
    """What two plans of a spec leave of its requirements."""
    both = [residuals_of_plan(one) for one in (spec, plan)]
    return tuple(
        RequirementChange(r.name, UNIT_OF[r.quantity][0], *(of[r.name].statistic() for of in both))
        for r in spec.requirement
    )


def targets_met(spec: Spec) -> bool:
    """Whether a plan meets every target by its rule, with `MARGIN`. Errors: `ValueError` where there is no target."""
    limits = {r.name: limit for r in spec.requirement if (limit := limit_of(r)) is not None}
    if not limits:
        raise ValueError(NO_TARGET)
    return _within(spec, limits, 1.0 - MARGIN)


def _within(spec: Spec, limits: Mapping[str, tuple[Statistic, float]], share: float) -> bool:
    """Whether the named requirements are within that share of their limits, by the terms that the spec names."""
    found = residuals_of_plan(spec)
    left = {name: found[name].statistic(statistic) for name, (statistic, _) in limits.items()}
    return all(value is not None and value <= share * limits[name][1] for name, value in left.items())


def search_turns(
    spec: Spec,
    *,
    steps: int = STEPS,
    quick: bool = False,
    until_met: bool = False,
    motion: float | None = None,
    checkpoint: Mapping[str, np.ndarray] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, for one gyro along the only axis of a table; a step every few iterations.

    `steps`: iterations of each start. `quick`: few starts, and a brief polish by the same program. `motion` s: time
    without soaks, in the place of [design]'s.
    """
    design = design_of(spec)
    resumed = None if checkpoint is None else _Checkpoint.of(checkpoint)
    of = measure(spec)
    before = exact(spec, of)
    known = finite(before)

    def enough(plan: Callable[[], Spec], value: float, words: str, sentence: str) -> Optimised | None:
        """The rounded plan, where it meets every target with margin in every scenario."""
        try:
            candidate = rounded(plan(), steps_of(spec)).spec
        except SpecError:
            return None
        if not all(targets_met(scenario) for scenario, _ in scenario_specs(candidate)):
            return None
        now = exact(candidate, of)
        rows = requirement_changes(spec, candidate)
        return Optimised(candidate, of.name, of.unit, known, value, now, True, sentence, rows, words)

    if until_met:
        if design.notice is not None:
            raise ValueError("a search until every target is met ignores design.notice: leave one of them out")
        own = enough(lambda: spec, before, "as it was", f"the plan as it was: {MET}, and nothing was searched")
        if own is not None:
            yield own
            return

    def reached_by(compiled: Compiled, state: SearchState) -> tuple[float, str]:
        """The objective at the best point of a search, and the limits that it exceeds."""
        value, excess = exactly(compiled, state.best_point)
        return value, missed_limit(excess, of.limits)

    choices = structures(spec, [s for s, _ in scenario_specs(spec)], motion=motion)
    best = None if resumed is None else (resumed.best_structure, resumed.best)
    value, missed = np.inf, ""
    if best is not None:
        value, missed = reached_by(of.compiled(choices[best[0]].coordinates), best[1])
    first, state = (0, None) if resumed is None else (resumed.structure, resumed.state)
    for k in range(first, len(choices)):
        choice, options = choices[k], {"steps": steps, "quick": quick, "state": state, "stop": stop}
        compiled = of.compiled(choice.coordinates)
        for progress in search(
            compiled, starts=design.starts, seed=design.seed, begin=choice.start, alone=choice.alone, **options
        ):
            better = best is None or progress.best < best[1].best
            if best is None or better:
                best = k, progress.state
                value, missed = reached_by(compiled, progress.state)
            share = (k + progress.step / progress.steps) / len(choices)
            yield SearchStep(
                of.name,
                of.unit,
                known,
                value,
                0.95 * share,
                choices[k].words,
                missed,
                _Checkpoint(k, progress.state, *best).arrays(),
            )
            if until_met and better:
                point, coordinates = progress.state.best_point, choices[k].coordinates
                decoded = partial(plan_to_spec, spec, coordinates, point)
                if early := enough(decoded, value, choices[k].words, f"stopped early: {MET}"):
                    yield early
                    return
            if stop():
                break
        state = None
        if stop():
            break
    assert best is not None
    yield finished(spec, of, known, choices[best[0]], best[1], motion, stop, quick)


def finished(
    spec: Spec,
    of: Measure,
    before: float | None,
    structure: Structure,
    state: SearchState,
    motion: float | None,
    stop: Callable[[], bool],
    quick: bool,
) -> Optimised:
    """Polish and round the best point of a search; keep the spec's own plan where that is as good."""
    coordinates, optimum = polished(
        of, structure.coordinates, state.best_point, design_of(spec).seed, stop, quick=quick
    )
    # Rounded as in a recipe, so that the value is that of the executed plan. A plan is returned in every case.
    sentence, converged = optimum.sentence, optimum.converged
    try:
        plan = rounded(plan_to_spec(spec, *_pruned(of, coordinates, optimum.point)), steps_of(spec)).spec
        now = exact(plan, of)
    except SpecError as error:
        plan, now = spec, np.inf
        sentence = f"the optimum cannot be rounded to the controllers' steps: {error}"
    if not np.isfinite(now):
        converged = False
        hint = "give finer ones"
        if any(r.name == design_of(spec).minimise and r.quantity in ("heading", "north") for r in spec.requirement):
            hint = "add priors for the maps, or targets for other requirements: a mission alone constrains little else"
        sentence = f"rounded to the controllers' steps, the plan does not observe enough: {hint}; {sentence}"
    elif now > (1.0 + _DEAR) * optimum.value:
        more = 100.0 * (now / optimum.value - 1.0)
        sentence += f"; rounding to the controllers' steps and whole readings costs {more:.2g} % of it: give finer ones"
    # The spec's own plan stays where it is as good and misses no target that the new one meets, or where it alone meets
    # the targets.
    kept = False
    if before is not None and motion is None:
        own = _within_limits(spec, of)
        kept = (own and (now >= before or not optimum.held)) or (now >= before and not _within_limits(plan, of))
    if kept or not np.isfinite(now):
        try:
            plan = rounded(spec, steps_of(spec)).spec
        except SpecError:
            plan, sentence = spec, f"{sentence}; the plan in the file cannot be rounded either, and remains unchanged"
        now, converged = exact(plan, of), False
    if kept:
        sentence = (
            f"no plan is better than the plan in the file ({now:.4g} {of.unit}), which remains; try more "
            "moves or starts"
        ) + (f" ({sentence})" if not np.isfinite(now) or not optimum.held or optimum.value < 0.9 * now else "")
    compiled = of.compiled(structure.coordinates)
    ends = [exactly(compiled, point) for point in state.points]
    turns = isinstance(coordinates, Coordinates)
    return Optimised(
        plan,
        of.name,
        of.unit,
        before,
        optimum.value,
        now,
        converged,
        sentence,
        requirement_changes(spec, plan),
        structure.words,
        kept or plan is spec,
        tuple(sorted(value if np.all(excess <= KEPT) else float(np.inf) for value, excess in ends)),
        optimum.gradient_norm,
        active_limits(coordinates, optimum.point) if turns else (),
        shadow_prices(of, coordinates, optimum) if turns else (),
    )


def polished(
    of: Measure,
    coordinates: AnyCoordinates,
    point: np.ndarray,
    seed: int = 0,
    stop: Callable[[], bool] = lambda: False,
    *,
    quick: bool = False,
) -> tuple[AnyCoordinates | ProgrammeKnots, Optimum]:
    """The local optimum from the best point of a search, with its coordinates; without turns that vanish."""
    # Fewer turns would be another size class, which would have to be compiled.
    if not quick:
        coordinates, point = _pruned(of, coordinates, point)
    if isinstance(coordinates, ProgrammeCoordinates):
        return best_programme(of, *coordinates.knots(point), seed, stop)
    if quick:
        return coordinates, polish(of.compiled(coordinates), point, steps=_BRIEF_POLISH, names=of.limits)
    optimum = polish(of.compiled(coordinates), point, steps=_FIRST, rounds=1, names=of.limits)
    for _ in range(_POLISHES):
        if optimum.converged:
            break
        # A vanishing turn leaves a flat valley in which a polish does not converge, so it is removed.
        fewer, point = _pruned(of, coordinates, optimum.point)
        again = polish(of.compiled(fewer), point, steps=_POLISH, rounds=1, names=of.limits)
        allowed = optimum.value * (1.0 + _NO_WORSE) if fewer.size < coordinates.size else optimum.value
        if not again.held or again.value > allowed:
            break
        gained = again.value < optimum.value or fewer.size < coordinates.size
        coordinates, optimum = fewer, again
        if not gained:
            break
    return coordinates, optimum


def _within_limits(spec: Spec, of: Measure) -> bool:
    """Whether the prediction of the spec's own plan meets the targets that limit the search."""
    limits = {r.name: limit for r in spec.requirement if r.name in of.limits and (limit := limit_of(r)) is not None}
    return (not limits or _within(spec, limits, 1.0)) and of.notices(assemble(spec).schedule)


def best_programme(
    of: Measure, knots: ProgrammeKnots, point: np.ndarray, seed: int, stop: Callable[[], bool]
) -> tuple[ProgrammeKnots, Optimum]:
    """Polish a programme, then polish from random steps about the best: programmes that lie on different limits are
    separate local optima."""
    objective, linear = of.compiled(knots), knots.limits
    optimum, generator = polish(objective, point, linear=linear, names=of.limits), np.random.default_rng(seed)
    for k in range(_HOPS):
        if stop():
            break
        step = _HOP_STEPS[k % len(_HOP_STEPS)] * generator.standard_normal(point.shape)
        other = polish(objective, knots.near(optimum.point + step), linear=linear, names=of.limits)
        if other.held and other.value < optimum.value:
            optimum = other
    return knots, optimum


def _pruned(of: Measure, coordinates: AnyCoordinates, point: np.ndarray) -> tuple[AnyCoordinates, np.ndarray]:
    """The plan without turns that shrank to nothing, unless that costs more than rounding may: a plan of few turns may
    need even the briefest.

    Where travel is limited all turns may be brief; there those that round to nothing are written as rests.
    """
    if not isinstance(coordinates, Coordinates) or "duration" not in coordinates.free or coordinates.travels:
        return coordinates, point
    fewer, cycle = coordinates.pruned(coordinates.cycle(np.asarray(point)))
    left = fewer.vector(cycle)
    if of.exact(fewer.decode(left)) > (1.0 + _DEAR) * of.exact(coordinates.decode(point)):
        return coordinates, point
    return fewer, left


def active_limits(coordinates: Coordinates, point: np.ndarray) -> tuple[str, ...]:
    """Which limits bind, in words."""
    cycle = coordinates.cycle(point)
    peaks = np.abs(cycle.peak_rates)[coordinates.turns]
    fastest = int(np.sum(peaks > float(coordinates.limits.max_rate) * (1.0 - _AT_LIMIT)))
    binding = ["the time at the table"]
    if fastest:
        binding.append(f"the maximum rate, in {fastest} of {len(peaks)} turns")
    if coordinates.travels:
        angles = np.cumsum(coordinates.angles(cycle))
        if np.max(np.abs(angles)) > float(coordinates.limits.travel) * (1.0 - _AT_LIMIT):
            binding.append("the travel")
    if "gradient" in coordinates.free:
        slopes = np.abs(cycle.steps) / coordinates.lasting()
        steep = int(np.sum(slopes > float(coordinates.limits.max_slope) * (1.0 - _AT_LIMIT)))
        if steep:
            binding.append(f"the chamber's slope, in {steep} of {len(slopes)} stretches")
    return tuple(binding)


# Limits by the index of `Coordinates.eased`: name, unit in which the limit is eased, and that unit in SI.
PRICED: Final = (
    ("ramp time, cycle and turns with it", "minute", 60.0),
    ("largest rate", "deg/s", np.pi / 180.0),
    ("largest acceleration", "deg/s^2", np.pi / 180.0),
    ("travel", "turn", 2.0 * np.pi),
    ("chamber slope", "K/min", 1.0 / 60.0),
)


def shadow_prices(of: Measure, coordinates: Coordinates, optimum: Optimum) -> tuple[Price, ...]:
    """The objective's derivatives in the limits. At an optimum the derivative through the free numbers vanishes
    (envelope theorem); the multipliers count that easing a limit also changes the binding targets."""
    compiled = of.compiled(coordinates)
    slopes, costs = compiled(optimum.point), multipliers(compiled, optimum.point)
    derivatives = slopes.of_eased[0] + costs @ slopes.of_eased[1:]
    bound = (True, True, True, coordinates.travels, "gradient" in coordinates.free)
    start, places = slopes.logs[0] + costs @ slopes.logs[1:], np.flatnonzero(bound)

    def change(k: int, step: float) -> float:
        logs = compiled(optimum.point, by=step * np.eye(len(derivatives))[places[k]]).logs
        return logs[0] + costs @ logs[1:] - start

    limits = [PRICED[k] for k in places]
    return priced(float(np.exp(slopes.logs[0])), limits, derivatives[places].tolist(), change)
