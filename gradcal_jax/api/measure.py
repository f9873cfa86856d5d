"""The objective of a spec's [design] for the search of one gyro's turns, of the chamber, or of set points."""

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from gradcal_jax.api.build import assemble
from gradcal_jax.api.exact_objective import MISSED, ExactObjective, optimality
from gradcal_jax.api.imu_residual import box, heading_contrasts
from gradcal_jax.api.systematic import counted_criterion
from gradcal_jax.api.tested_maps import hidden_test, with_hidden
from gradcal_jax.api.verdicts import mission_weights
from gradcal_jax.design import AnyCoordinates, Case, Compiled, Coordinates, Criterion, Objective, polynomial_grid
from gradcal_jax.files import changed
from gradcal_jax.files.design import ALL, OPTIMALITIES, Design
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.requirement import MissionHeadingRequirement, NorthRequirement, Requirement
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import begin_filter, contrasts, noise_states, where_hidden
from gradcal_jax.information.residual import Statistic, map_of
from gradcal_jax.model import BIAS, SCALE_FACTOR, HigherPolynomials, Map, Polynomial, SensorModel
from gradcal_jax.trajectory import Schedule, rule_of

# The search sees a requirement's box on a grid of at most this many temperatures and rates.
_GRID = 41


class Measure(NamedTuple):
    """The objective of a [design] as a function of a plan's numbers.

    `cases`, `factors`, `targets`, `robust`: of an `Objective`, which `compiled` makes for coordinates.
    """

    objective: ExactObjective
    cases: tuple[Case, ...]
    factors: np.ndarray
    targets: np.ndarray
    robust: Literal["worst", "mean"]

    @property
    def limits(self) -> tuple[str, ...]:
        """What has a target that is a limit."""
        return tuple(aim.name for aim in self.objective.aims if aim.limiting)

    def compiled(self, coordinates: AnyCoordinates) -> Compiled:
        """The objective over coordinates, through the program of the class of their sizes."""
        # Any plan in which everything moves determines the quadrature rule.
        plan = coordinates.decode(np.linspace(0.1, 0.9, coordinates.size))
        lines = [case.trajectory(plan) for case in self.cases]
        for case, line in zip(self.cases, lines, strict=True):
            begin_filter(noise_states(line, case.model))
        cases = tuple(replace(c, rule=rule_of(c.model, line)) for c, line in zip(self.cases, lines, strict=True))
        whole, places = coordinates, None
        if isinstance(coordinates, Coordinates):
            whole = coordinates.padded()
            places = coordinates.places_in(whole)
        objective = Objective(whole, cases, self.factors, self.targets, self.robust)
        return Compiled(objective, whole.size, places)

    def logs(self, schedule: Schedule) -> np.ndarray:
        """Logarithms of the exact value of one plan, and of its excess over limits."""
        value, excess = Objective(None, self.cases, self.factors, self.targets, self.robust).of_schedule(schedule)
        return np.log([value, *np.exp(excess)])

    def exact(self, schedule: Schedule) -> float:
        """The exact value of one plan, in the unit."""
        return float(np.exp(self.logs(schedule)[0]))


def design_of(spec: Spec) -> Design:
    """The spec's [design]. Errors: `ValueError` where it has none."""
    if spec.design is None:
        raise ValueError(
            f"the spec has no [design]: state the objective and the free parts. To paste:\n\n{design_block(spec)}"
        )
    return spec.design


def design_block(spec: Spec) -> str:
    """A [design] for the spec's own requirement and kind of plan, as text to paste."""
    name = spec.requirement[0].name if spec.requirement else "D-optimality"
    if isinstance(spec.plan, StandardPlan):
        free = '"temperatures", "integration"' + (', "rates"' if any(spec.plan.rates or ()) else "")
    elif not spec.turns_one_gyro:
        return f'[design]\nminimise = "{name if spec.requirement else ALL}"'
    else:
        free = '"duration", "peak_rate"' if spec.plan.cycle is not None else '"programme"'
    return f'[design]\nminimise = "{name}"\nfree     = [{free}]\nstarts   = 8'


def measure(spec: Spec) -> Measure:
    """The objective of the spec's [design]."""
    design, exact = design_of(spec), ExactObjective(spec)
    counted = [aim for aim in exact.aims if aim.counted]
    limiting = [aim for aim in exact.aims if aim.limiting]
    cases = []
    for case in exact.cases:
        one = case.spec
        if design.whole_turns:
            # Whole turns cancel the encoder's harmonics; while turns are not yet whole, these only disturb the search.
            one = changed(one, {"rig.table.axis[0].angle.harmonics": None})
        built = assemble(one)
        model, believed = built.model, None
        criteria: dict[str, Any] = {}
        for r, aim in zip(spec.requirement, exact.aims, strict=False):
            if aim.counted or aim.limiting:
                criteria[r.name] = counted_criterion(criterion_of(model, r, aim.statistic, _GRID), built)
        if design.minimise in OPTIMALITIES:
            criteria[design.minimise] = optimality(model, design.minimise)
        if design.notice is not None:
            if where_hidden(model, SCALE_FACTOR) is None:
                model, believed = with_hidden(one, model, SCALE_FACTOR), model.size
            criteria[MISSED] = hidden_test(model, design.notice, 0)
        own, limits = (tuple(criteria[aim.name] for aim in of) for of in (counted, limiting))
        lag = None if built.thermal_lag is None else np.asarray(built.thermal_lag)
        cases.append(Case(model, lag, own, limits, np.asarray(case.weight), believed=believed, past=built.past))
    # A criterion is SI.
    factors = np.array([aim.per_si / aim.limit for aim in counted])
    targets = np.array([aim.limit / aim.per_si for aim in limiting])
    return Measure(exact, tuple(cases), factors, targets, design.robust if len(cases) > 1 else "mean")


def criterion_of(
    model: SensorModel, requirement: Requirement, name: Statistic | None = None, most: int | None = None
) -> Criterion:
    """A gyro's requirement, by its own statistic or that of a `name`, as a criterion of its model's parameters (SI).
    `most`: see `box`; for a search, which interpolates a polynomial map between few places."""
    name, at, between = name or requirement.statistic, box(requirement, most), None
    shape = len(at[0]), len(at[1])
    quantity = SCALE_FACTOR if requirement.quantity.endswith("scale_factor") else BIAS
    if most is not None and not isinstance(requirement, MissionHeadingRequirement):
        at, between = _few_places(map_of(model, quantity), *at)
    if isinstance(requirement, MissionHeadingRequirement | NorthRequirement):
        of = heading_contrasts(model, requirement, at[0])
    else:
        of = contrasts(model, quantity, *(g.ravel() for g in np.meshgrid(*at, indexing="ij")))
    # Such that the unweighted statistic of missions is the weighted one.
    rows, alone, beyond = of.times(mission_weights(requirement, name)[:, 0])
    return Criterion(rows, alone if np.any(alone) else None, beyond, shape, name, between)


def _few_places(of: Map, temperatures: np.ndarray, rates: np.ndarray):
    """The places at which a map's residual is evaluated, and the matrices that interpolate it onto the grid."""
    bases = [(of.temperature, of.beyond and of.beyond.temperature), (of.rate, of.beyond and of.beyond.rate)]
    pairs = []
    for at, both in zip((temperatures, rates), bases, strict=True):
        degrees = [
            b.degree if isinstance(b, Polynomial | HigherPolynomials) else len(at) for b in both if b is not None
        ]
        pairs.append(polynomial_grid(at, max(degrees, default=0)))
    (few_t, by_t), (few_w, by_w) = pairs
    return (few_t, few_w), (by_t, by_w)
