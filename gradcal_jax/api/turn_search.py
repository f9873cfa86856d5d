"""The search for the course of one gyro's turns, of the chamber, or of set points, that minimises a [design]'s
objective; its result is rounded, with the limits that bind it."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.api.measure import Measure, design_of, measure
from gradcal_jax.api.plan_to_spec import plan_to_spec
from gradcal_jax.api.scenarios import scenario_specs
from gradcal_jax.api.search_results import Optimised, Price, PricedLimit, priced
from gradcal_jax.api.searching import PlanOutcome
from gradcal_jax.api.structures import structures
from gradcal_jax.design import (
    KEPT,
    AnyCoordinates,
    Coordinates,
    Optimum,
    ProgrammeCoordinates,
    SearchState,
    exactly,
    multipliers,
    polish,
    search,
)
from gradcal_jax.files.spec_sections import Spec

STEPS: Final = 240
# A point is proposed once it is better than the last one by this factor: its plan takes longer to judge than a value.
_NEWS: Final = 0.95
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
# Rounds of random steps from the best programme at most, their sizes, the steps of each descent, and the gain of a
# round that counts as none.
_ROUNDS: Final = 6
_HOP_SIZES: Final = (0.1, 0.3, 0.6, 1.0) * 4
_HOP_STEPS: Final = 100
_NO_GAIN: Final = 1e-5


class _At(NamedTuple):
    """Where a search is: the number of a structure, and the state there."""

    structure: int
    state: SearchState


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


class TurnPoint(NamedTuple):
    """A plan of a structure: its coordinates, the vector, and the structure in words."""

    coordinates: AnyCoordinates
    vector: np.ndarray
    words: str


class TurnSearch:
    """The search for one gyro along the only axis of a table: of every structure, many starts; then a polish.

    `steps`: iterations of each start. `quick`: few starts, and a brief polish by the same program. `motion` s: time
    without soaks, in the place of [design]'s; the spec's own plan, which has another, then counts for nothing.
    """

    def __init__(
        self, spec: Spec, *, steps: int, quick: bool, motion: float | None, stop: Callable[[], bool] = lambda: False
    ) -> None:
        self._of, self._options = measure(spec), {"steps": steps, "quick": quick, "stop": stop}
        self._choices = structures(spec, [s for s, _ in scenario_specs(spec)], motion=motion)
        self.objective, self.own_counts = self._of.objective, motion is None
        self._now: _At | None = None
        self._best: _At | None = None
        self._optimum: tuple[AnyCoordinates, Optimum] | None = None

    def run(self) -> Iterator[tuple[float, TurnPoint]]:
        """The best point after every descent, or one that is not much worse."""
        design, stop = design_of(self.objective.spec), self._options["stop"]
        first, state = self._now or (0, None)
        point, proposed = None if self._best is None else self._point(self._best), np.inf
        for k in range(first, len(self._choices)):
            choice = self._choices[k]
            options = {"starts": design.starts, "seed": design.seed, "begin": choice.start, "alone": choice.alone}
            for progress in search(self._of.compiled(choice.coordinates), state=state, **options, **self._options):
                self._now = _At(k, progress.state)
                if self._best is None or progress.best < self._best.state.best:
                    self._best = self._now
                if point is None or self._best.state.best < _NEWS * proposed:
                    point, proposed = self._point(self._best), self._best.state.best
                yield 0.95 * (k + progress.step / progress.steps) / len(self._choices), point
                if stop():
                    break
            state = None
            if stop():
                break
        assert self._best is not None
        point, quick = self._point(self._best), self._options["quick"]
        coordinates, optimum = self._optimum = polished(self._of, *point[:2], design.seed, stop, quick=quick)
        yield 1.0, TurnPoint(*_pruned(self._of, coordinates, optimum.point), point.words)

    def _point(self, at: _At) -> TurnPoint:
        choice = self._choices[at.structure]
        return TurnPoint(choice.coordinates, at.state.best_point, choice.words)

    def plan_of(self, point: TurnPoint) -> tuple[Spec, str]:
        """The plan of a point, and its structure in words."""
        return plan_to_spec(self.objective.spec, point.coordinates, point.vector), point.words

    def state(self, reached: TurnPoint | None) -> dict[str, np.ndarray]:
        """Arrays from which `resume` continues."""
        del reached
        if self._now is None or self._best is None:
            return {}
        arrays = {"at": np.array([self._now.structure, self._best.structure])}
        for name, at in (("state", self._now), ("best", self._best)):
            arrays |= {f"{name}_{field}": np.asarray(value) for field, value in at.state._asdict().items()}
        return arrays

    def resume(self, arrays: Mapping[str, np.ndarray]) -> TurnPoint:
        """Continue from such arrays; returns the best point so far."""

        def state(name: str) -> SearchState:
            of: Any = (arrays[f"{name}_{field}"] for field in SearchState._fields)
            return SearchState(*(value if value.ndim else value.item() for value in of))

        now, best = (int(k) for k in arrays["at"])
        self._now, self._best = _At(now, state("state")), _At(best, state("best"))
        return self._point(self._best)

    def record(self, best: Optimised, point: TurnPoint | None, last: PlanOutcome) -> dict[str, Any]:
        """The optimum before rounding, and what rounding made of it."""
        if self._optimum is None or self._best is None:
            return {"converged": True}
        coordinates, optimum = self._optimum
        spec, sentence = self.objective.spec, optimum.sentence
        if last.trouble:
            sentence = f"the optimum cannot be rounded to the controllers' steps: {last.trouble}"
        elif not np.isfinite(last.value):
            hint = "give finer ones"
            name = design_of(spec).minimise
            if any(r.name == name and r.quantity in ("heading", "north") for r in spec.requirement):
                hint = (
                    "add priors for the maps, or targets for other requirements: a mission alone constrains little else"
                )
            sentence = f"rounded to the controllers' steps, the plan does not observe enough: {hint}; {sentence}"
        elif last.value > (1.0 + _DEAR) * optimum.value:
            more = 100.0 * (last.value / optimum.value - 1.0)
            sentence += (
                f"; rounding to the controllers' steps and whole readings costs {more:.2g} % of it: give finer ones"
            )
        compiled = self._of.compiled(self._choices[self._best.structure].coordinates)
        ends = [exactly(compiled, end) for end in self._best.state.points]
        turns = coordinates if point is not None and isinstance(coordinates, Coordinates) else None
        return {
            "sentence": sentence,
            "converged": optimum.converged and bool(np.isfinite(last.value)) and not best.kept,
            "optimum": optimum.value,
            "starts": tuple(sorted(value if np.all(excess <= KEPT) else float(np.inf) for value, excess in ends)),
            "gradient_norm": optimum.gradient_norm,
            "active": () if turns is None else active_limits(turns, optimum.point),
            "prices": () if turns is None else shadow_prices(self._of, turns, optimum),
        }


def polished(
    of: Measure,
    coordinates: AnyCoordinates,
    point: np.ndarray,
    seed: int = 0,
    stop: Callable[[], bool] = lambda: False,
    *,
    quick: bool = False,
) -> tuple[AnyCoordinates, Optimum]:
    """The local optimum from the best point of a search, with its coordinates; without turns that vanish."""
    # Fewer turns would be another size class, which would have to be compiled.
    if not quick:
        coordinates, point = _pruned(of, coordinates, point)
    if isinstance(coordinates, ProgrammeCoordinates):
        return coordinates, best_programme(of, coordinates, point, seed, stop)
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


def best_programme(
    of: Measure, coordinates: ProgrammeCoordinates, point: np.ndarray, seed: int, stop: Callable[[], bool]
) -> Optimum:
    """Polish a programme, then polish from random steps about the best until they gain nothing: programmes that lie on
    different limits are separate local optima, and where slopes are clipped the gradient need not vanish."""
    objective, generator = of.compiled(coordinates), np.random.default_rng(seed)
    optimum = polish(objective, point, names=of.limits)
    for _ in range(_ROUNDS):
        before = optimum.value
        for size in _HOP_SIZES:
            if stop():
                return optimum
            other = optimum.point + size * generator.standard_normal(point.shape)
            other = polish(objective, other, steps=_HOP_STEPS, rounds=1, names=of.limits)
            if other.held and (other.value < optimum.value or not optimum.held):
                optimum = other
        if optimum.held and optimum.value > (1.0 - _NO_GAIN) * before:
            sentence = f"converged: none of {len(_HOP_SIZES)} descents from points about it ends lower"
            return optimum if optimum.converged else optimum._replace(converged=True, sentence=sentence)
    return optimum


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


def shadow_prices(of: Measure, coordinates: Coordinates, optimum: Optimum) -> tuple[Price, ...]:
    """The objective's derivatives in the limits. At an optimum the derivative through the free numbers vanishes
    (envelope theorem); the multipliers count that easing a limit also changes the binding targets."""
    limits, costs = coordinates.limits, np.append(1.0, multipliers(of.compiled(coordinates), optimum.point))
    travel = limits.travel if coordinates.travels else 0.0
    slope = limits.max_slope if "gradient" in coordinates.free else 0.0
    sizes = coordinates.frame.motion_time, limits.max_rate, limits.max_acceleration, travel, slope
    rows = [PricedLimit(*row, float(size)) for row, size in zip(PRICED, sizes, strict=True)]
    logs = lambda by: of.logs(coordinates.eased(by).decode(optimum.point))  # noqa: E731
    return priced(optimum.value, rows, lambda by: float(costs @ logs(by)))


# Limits by the index of `Coordinates.eased`: name, unit in which the limit is eased, and that unit in SI.
PRICED: Final = (
    ("ramp time, cycle and turns with it", "minute", 60.0),
    ("largest rate", "deg/s", np.pi / 180.0),
    ("largest acceleration", "deg/s^2", np.pi / 180.0),
    ("travel", "turn", 2.0 * np.pi),
    ("chamber slope", "K/min", 1.0 / 60.0),
)
