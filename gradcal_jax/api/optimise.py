"""`optimise`: from a spec with [design] to the best plan found, rounded, with what there is to say about it."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.api.build import assemble
from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.measure import Measure, design_of, measure
from gradcal_jax.api.plan_to_spec import plan_to_spec
from gradcal_jax.api.posterior_of_plan import limit_of
from gradcal_jax.api.prediction import predict
from gradcal_jax.api.scenarios import scenario_specs
from gradcal_jax.api.structures import Structure, structures
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
from gradcal_jax.files import Spec, SpecError
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.rounding import rounded, steps_of

STEPS: Final = 240
MARGIN: Final = 0.1
"""A target is met with margin where the residual stays this share below what it asks for."""
_MET: Final = f"every target is met with a margin of {MARGIN:.0%}"
BY_HAND: Final = (
    'rig.table.drive is "hand": the search makes turns of a motor. Search the plan with drive = "motor" and moves '
    'without shape = "hand", then write its turns as ones by hand, with the durations that a person needs'
)
"""Why no plan of turns by hand is searched."""
# A turn within this share of its cap is said to be at its limit.
_AT_LIMIT: Final = 1e-3
_FIRST: Final = 100
_POLISH: Final = 1000
_POLISHES: Final = 3
_BRIEF_POLISH: Final = 40
# What leaving out vanished turns may cost.
_NO_WORSE: Final = 1e-3
# Rounding that costs more than this share is said.
_DEAR: Final = 0.05
# From the best programme so many steps of these sizes (shares of the time, of the chamber's range) are tried.
_HOPS: Final = 80
_HOP_STEPS: Final = (0.05, 0.1, 0.2, 0.4)


class SearchStep(NamedTuple):
    """How far an optimisation is: `best` in `unit`, of `name`; `share` of the work that is done, 0 to 1.

    `missed`: what the best plan so far does not keep, in words.
    """

    name: str
    unit: str
    before: float | None
    best: float
    share: float
    words: str
    missed: str
    checkpoint: "Checkpoint"


class Checkpoint(NamedTuple):
    """All that an optimisation needs to go on: which structure it is at, its state, and the best of those before."""

    structure: int
    state: SearchState
    best_structure: int
    best: SearchState


class Price(NamedTuple):
    """What a limit costs: how the objective changes when the limit is eased by one `per`."""

    limit: str
    per: str
    change: float


class Optimised(NamedTuple):
    """An optimised spec (rounded) and how it was found. Values in `unit`.

    `before`: of the plan in the spec, None where it observes too little; `found`: of the optimum; `now`: of the rounded
    plan, exactly. `starts`: where the starts of the chosen structure ended, `inf` where one exceeds a limit. `active`:
    the limits that bind, in words.
    """

    spec: Spec
    name: str
    unit: str
    before: float | None
    found: float
    now: float
    converged: bool
    sentence: str
    starts: tuple[float, ...]
    gradient_norm: float | None
    active: tuple[str, ...]
    prices: tuple[Price, ...]
    structure: str


def belief_of(spec: Spec) -> str:
    """What a design without a discrepancy believes, as a sentence; empty where every polynomial map has one."""
    sections = {"bias": spec.sensor.bias, "scale factor": spec.sensor.scale_factor}
    sure = [name for name, s in sections.items() if s is not None and s.discrepancy is None and s.smoothness is None]
    if not sure:
        return ""
    return (
        f"believed: the {' and the '.join(sure)} {'have' if len(sure) > 1 else 'has'} exactly the structure of the "
        "spec; a discrepancy there says how far from it they may be, and gives a plan that survives it"
    )


def record_of(best: Optimised) -> dict[str, object]:
    """What a recipe and --json keep of an optimisation."""
    record: dict[str, object] = {
        "before": best.before,
        "objective": best.name,
        "unit": best.unit,
        "found": best.found,
        "now": finite(best.now),
        "converged": best.converged,
        "sentence": best.sentence,
        "gradient_norm": best.gradient_norm,
        "structure": best.structure,
        "starts": [float(f"{v:.6g}") for v in best.starts if np.isfinite(v)] or None,
        "active_limits": list(best.active),
        "shadow_prices": [{"limit": p.limit, "per": p.per, "change": p.change} for p in best.prices],
    }
    return {name: value for name, value in record.items() if value is not None}


def exact(spec: Spec, of: Measure) -> float:
    """The exact value of a spec's own plan, on the requirement's own grid; `inf` where it observes too little."""
    design = design_of(spec)
    rows = [row for row in spec.requirement if row.name == design.minimise]
    if rows and len(of.cases) == 1:
        # Of several axes the worst.
        found = [row.decisive for row in predict(spec).requirements if row.name == rows[0].name]
        return max(np.inf if value is None else value for value in found)
    built = assemble(spec)
    value = of.exact(built.schedules[built.channels[0]])
    return value if np.isfinite(value) else np.inf


def targets_met(spec: Spec) -> bool:
    """Whether a plan meets every target by its rule, with `MARGIN`. Errors: `ValueError` where there is no target."""
    limits = {r.name: limit for r in spec.requirement if (limit := limit_of(r)) is not None}
    if not limits:
        raise ValueError("to stop when every target is met, give a requirement a target")
    for row in predict(spec).requirements:
        if row.name in limits:
            name, most = limits[row.name]
            value = {"mean of max": row.mean_of_max, "max": row.max, "mean": row.mean, "rms": row.rms}[name]
            if value is None or value > (1.0 - MARGIN) * most:
                return False
    return True


def optimise(
    spec: Spec,
    *,
    steps: int = STEPS,
    quick: bool = False,
    until_met: bool = False,
    motion: float | None = None,
    checkpoint: Checkpoint | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """Yield a `Step` every few iterations and the `Optimised` plan at the end.

    `quick`: few starts, and a brief polish by the same program. `until_met`: no further than to a plan that, rounded,
    meets every target with `MARGIN`, and nothing where the spec's own does. `motion` s: time without soaks, in the
    place of [design]'s. `checkpoint`: go on from a step's. `stop`: asked after every step; once true, the best so far
    is finished. Errors: `ValueError` when limits exclude each other, nothing can be observed, the table is turned by
    hand or, with `until_met`, there is no target.
    """
    design = design_of(spec)
    if spec.rig.table.drive == "hand" and not (isinstance(spec.plan, StandardPlan) or spec.plan.cycle is None):
        raise ValueError(BY_HAND)
    of = measure(spec)
    before = exact(spec, of)
    known = finite(before)

    def enough(plan: Callable[[], Spec], value: float, words: str, sentence: str) -> Optimised | None:
        """The plan as the controllers take it, where that meets every target with margin in every scenario."""
        try:
            made = rounded(plan(), steps_of(spec)).spec
        except SpecError:
            return None
        if not all(targets_met(scenario) for scenario, _ in scenario_specs(made)):
            return None
        now = exact(made, of)
        return Optimised(made, of.name, of.unit, known, value, now, True, sentence, (), None, (), (), words)

    if until_met:
        if design.notice is not None:
            raise ValueError("a search until every target is met does not look at design.notice: leave one of them out")
        own = enough(lambda: spec, before, "as it was", f"the plan as it was: {_MET}, and nothing was searched")
        if own is not None:
            yield own
            return

    def reached_by(compiled: Compiled, state: SearchState) -> tuple[float, str]:
        """What the best point of a search comes to, and what it does not keep."""
        value, excess = exactly(compiled, state.best_point)
        return value, missed_limit(excess, of.limits)

    choices = structures(spec, [s for s, _ in scenario_specs(spec)], motion=motion)
    best = None if checkpoint is None else (checkpoint.best_structure, checkpoint.best)
    value, missed = np.inf, ""
    if best is not None:
        value, missed = reached_by(of.compiled(choices[best[0]].coordinates), best[1])
    first, state = (0, None) if checkpoint is None else (checkpoint.structure, checkpoint.state)
    for k in range(first, len(choices)):
        compiled = of.compiled(choices[k].coordinates)
        for progress in search(
            compiled,
            starts=design.starts,
            seed=design.seed,
            steps=steps,
            quick=quick,
            state=state,
            stop=stop,
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
                Checkpoint(k, progress.state, *best),
            )
            if until_met and better:
                point, coordinates = progress.state.best_point, choices[k].coordinates
                decoded = partial(plan_to_spec, spec, coordinates, point)
                if early := enough(decoded, value, choices[k].words, f"stopped early: {_MET}"):
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
    """Polish and round the best point of a search; the plan as it was where that is no better."""
    coordinates, found = polished(of, structure.coordinates, state.best_point, design_of(spec).seed, stop, quick=quick)
    # As a recipe will have it, so that the number is of what is executed. Whatever comes of it, a plan is written.
    sentence, converged = found.sentence, found.converged
    try:
        plan = rounded(plan_to_spec(spec, *_pruned(of, coordinates, found.point)), steps_of(spec)).spec
        now = exact(plan, of)
    except SpecError as error:
        plan, now = spec, np.inf
        sentence = f"the optimum cannot be rounded to the controllers' steps: {error}"
    if not np.isfinite(now):
        converged = False
        hint = "give finer ones"
        if any(r.name == design_of(spec).minimise and r.quantity in ("heading", "north") for r in spec.requirement):
            hint = "give the maps priors, or other requirements targets: a mission alone asks for little else"
        sentence = f"rounded to the controllers' steps the plan observes too little, {hint}; {sentence}"
    elif now > (1.0 + _DEAR) * found.value:
        more = 100.0 * (now / found.value - 1.0)
        sentence += f"; the controllers' steps and whole readings cost {more:.2g} % of it: give finer ones"
    kept = before is not None and now >= before and motion is None and _within_limits(spec, of)
    if kept or not np.isfinite(now):
        try:
            plan = rounded(spec, steps_of(spec)).spec
        except SpecError:
            plan, sentence = spec, f"{sentence}; nor can the plan as it was be rounded, which is kept as it is"
        now, converged = exact(plan, of), False
    if kept:
        sentence = (
            f"nothing better than the plan as it was ({now:.4g} {of.unit}): that is kept; try more moves or starts"
            + (f" ({sentence})" if not np.isfinite(now) or found.value < 0.9 * now else "")
        )
    return Optimised(
        plan,
        of.name,
        of.unit,
        before,
        found.value,
        now,
        converged,
        sentence,
        _ends(of.compiled(structure.coordinates), state),
        found.gradient_norm,
        active_limits(coordinates, found.point) if isinstance(coordinates, Coordinates) else (),
        shadow_prices(of, coordinates, found) if isinstance(coordinates, Coordinates) else (),
        structure.words,
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
    """The optimum that the best point of a search leads to, and its coordinates, without turns that vanish."""
    # Fewer turns would be another class of sizes, for which to compile.
    if not quick:
        coordinates, point = _pruned(of, coordinates, point)
    if isinstance(coordinates, ProgrammeCoordinates):
        return best_programme(of, *coordinates.knots(point), seed, stop)
    if quick:
        return coordinates, polish(of.compiled(coordinates), point, steps=_BRIEF_POLISH, names=of.limits)
    found = polish(of.compiled(coordinates), point, steps=_FIRST, rounds=1, names=of.limits)
    for _ in range(_POLISHES):
        if found.converged:
            break
        # Turns that vanish meanwhile leave valleys without end: without them it converges.
        fewer, point = _pruned(of, coordinates, found.point)
        again = polish(of.compiled(fewer), point, steps=_POLISH, rounds=1, names=of.limits)
        allowed = found.value * (1.0 + _NO_WORSE) if fewer.size < coordinates.size else found.value
        if not again.held or again.value > allowed:
            break
        gained = again.value < found.value or fewer.size < coordinates.size
        coordinates, found = fewer, again
        if not gained:
            break
    return coordinates, found


def _ends(compiled: Compiled, state: SearchState) -> tuple[float, ...]:
    """Where each start ended, the best first; `inf` where a limit is exceeded."""
    ends = [exactly(compiled, point) for point in state.points]
    return tuple(sorted(value if np.all(excess <= KEPT) else float(np.inf) for value, excess in ends))


def _within_limits(spec: Spec, of: Measure) -> bool:
    """Whether the spec's own plan keeps the targets that limit the search, as far as a prediction says."""
    rows = {row.name: row.verdict for row in predict(spec).requirements} if of.limits else {}
    return all(rows.get(name) == "met" for name in of.limits)


def best_programme(
    of: Measure, knots: ProgrammeKnots, point: np.ndarray, seed: int, stop: Callable[[], bool]
) -> tuple[ProgrammeKnots, Optimum]:
    """Polish a programme, hop from the best, polish again: programmes that differ in which limits they run along are
    optima of their own, between which no descent leads."""
    objective, linear = of.compiled(knots), knots.limits
    found, generator = polish(objective, point, linear=linear, names=of.limits), np.random.default_rng(seed)
    for k in range(_HOPS):
        if stop():
            break
        step = _HOP_STEPS[k % len(_HOP_STEPS)] * generator.standard_normal(point.shape)
        other = polish(objective, knots.near(found.point + step), linear=linear, names=of.limits)
        if other.held and other.value < found.value:
            found = other
    return knots, found


def _pruned(of: Measure, coordinates: AnyCoordinates, point: np.ndarray) -> tuple[AnyCoordinates, np.ndarray]:
    """The plan without turns that shrank to nothing, which are not for a technician to make, unless that costs what
    rounding may not: a plan of few turns may need even the briefest.

    Where travel is limited all turns may be brief, and more time would only make them slower: those that round to
    nothing are written as rests.
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
    found = ["the time at the table"]
    if fastest:
        found.append(f"the largest rate, in {fastest} of {len(peaks)} turns")
    if coordinates.travels:
        angles = np.cumsum(coordinates.angles(cycle))
        if np.max(np.abs(angles)) > float(coordinates.limits.travel) * (1.0 - _AT_LIMIT):
            found.append("the travel")
    if "gradient" in coordinates.free:
        slopes = np.abs(cycle.steps) / coordinates.lasting()
        steep = int(np.sum(slopes > float(coordinates.limits.max_slope) * (1.0 - _AT_LIMIT)))
        if steep:
            found.append(f"the chamber's slope, in {steep} of {len(slopes)} stretches")
    return tuple(found)


# What `Coordinates.eased` takes is in SI; people ease it by these.
PRICED: Final = (
    ("ramp time, cycle and turns with it", "minute", 60.0),
    ("largest rate", "deg/s", np.pi / 180.0),
    ("largest acceleration", "deg/s^2", np.pi / 180.0),
    ("travel", "turn", 2.0 * np.pi),
    ("chamber slope", "K/min", 1.0 / 60.0),
)


def shadow_prices(of: Measure, coordinates: Coordinates, found: Optimum) -> tuple[Price, ...]:
    """The objective's derivatives in the limits. At an optimum the free numbers need not move (envelope theorem), but
    what else binds (targets, what is to be noticed) is eased with them, at its own cost."""
    compiled = of.compiled(coordinates)
    slopes = compiled(found.point)
    given = np.exp(slopes.logs[0]) * (slopes.of_eased[0] + multipliers(compiled, found.point) @ slopes.of_eased[1:])
    bound = (True, True, True, coordinates.travels, "gradient" in coordinates.free)
    return tuple(
        Price(name, per, float(g) * size)
        for (name, per, size), g, counts in zip(PRICED, given, bound, strict=True)
        if counts
    )
