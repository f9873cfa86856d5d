"""The objective of a spec's [design]: one number of a plan, and by how much the plan exceeds the other targets."""

from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.criteria import criterion_of
from gradcal_jax.api.scenarios import scenario_specs
from gradcal_jax.api.structures import gyro_of
from gradcal_jax.api.systematic import counted_criterion
from gradcal_jax.api.tested_maps import hidden_test, with_hidden
from gradcal_jax.api.verdicts import UNIT_OF, limit_of
from gradcal_jax.design import KEPT, AnyCoordinates, Case, Compiled, Coordinates, Criterion, Objective, Optimality
from gradcal_jax.files import changed
from gradcal_jax.files.design import ALL, OPTIMALITIES, TIMES, Design, Notice
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import begin_filter, noise_states, where_hidden
from gradcal_jax.model import BIAS, SCALE_FACTOR
from gradcal_jax.trajectory import Schedule, rule_of

# The search sees a requirement's box on a grid of at most this many temperatures and rates.
_GRID = 41
MISSED = "the probability of missing a hidden map"


class Measure(NamedTuple):
    """The objective of a [design], in `unit`. `name`: for people. `limits`: requirements whose targets are limits.

    `cases`, `factors`, `targets`, `robust`: of an `Objective`, which `compiled` makes for coordinates.
    """

    name: str
    unit: str
    limits: tuple[str, ...]
    cases: tuple[Case, ...]
    factors: np.ndarray
    targets: np.ndarray
    robust: Any

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

    def exact(self, schedule: Schedule) -> float:
        """The exact value of one plan, in the unit."""
        return float(self._of(schedule)[0])

    def notices(self, schedule: Schedule) -> bool:
        """Whether a plan notices a hidden map as probably as it must."""
        return MISSED not in self.limits or float(self._of(schedule)[1][-1]) <= KEPT

    def _of(self, schedule: Schedule) -> tuple[Any, Any]:
        return Objective(None, self.cases, self.factors, self.targets, self.robust).of_schedule(schedule)


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
    """The objective of the spec's [design]; for a minimised time, the largest residual over its target."""
    design = design_of(spec)
    if design.whole_turns:
        # Whole turns cancel the encoder's harmonics; while turns are not yet whole, these only disturb the search.
        spec = changed(spec, {"rig.table.axis[0].angle.harmonics": None})
    scenarios = [(s, assemble(s), weight) for s, weight in scenario_specs(spec)]
    limiting = [r for r in spec.requirement if r.target is not None and r.name != design.minimise]
    if design.minimise in TIMES:
        if not limiting:
            raise ValueError(f'"{design.minimise}" is minimised under targets: give a requirement a target')
        name, unit = "residual over target", "of the target"
        mains = [[_criterion(built, r, limited=True) for r in limiting] for _, built, _ in scenarios]
        factors = [1.0 / _limit(r) for r in limiting]
        limiting = []
    elif design.minimise in OPTIMALITIES:
        name, unit = design.minimise, "ppm" if gyro_of(spec).scale_factor is not None else "deg/h"
        mains = [[_optimality(built, design.minimise)] for _, built, _ in scenarios]
        factors = [UNIT_OF["scale_factor" if unit == "ppm" else "bias"][1]]
    else:
        main = next(r for r in spec.requirement if r.name == design.minimise)
        unit, factor = UNIT_OF[main.quantity]
        name = f"{main.name} ({main.statistic})"
        mains, factors = [[_criterion(built, main)] for _, built, _ in scenarios], [factor]
    limits = [[_criterion(built, r, limited=True) for r in limiting] for _, built, _ in scenarios]
    targets = np.array([_limit(r) for r in limiting])
    names = tuple(r.name for r in limiting)
    models = [built.model for _, built, _ in scenarios]
    believed = None
    if design.notice is not None:
        models, noticing, believed = _noticing(scenarios, design.notice)
        # The chance of missing a hidden map has a target like any residual.
        allowed = 1.0 - float(design.notice.power)
        of_time = design.minimise in TIMES
        for every, one in zip(mains if of_time else limits, noticing, strict=True):
            every.append(one)
        if of_time:
            factors.append(1.0 / allowed)
        else:
            targets, names = np.append(targets, allowed), (*names, MISSED)
    cases = tuple(
        Case(
            model,
            None if built.thermal_lag is None else np.asarray(built.thermal_lag),
            tuple(main),
            tuple(limit),
            np.asarray(weight),
            believed=believed,
            past=built.past,
        )
        for model, (_, built, weight), main, limit in zip(models, scenarios, mains, limits, strict=True)
    )
    robust = design.robust if len(cases) > 1 else "mean"
    return Measure(name, unit, names, cases, np.array(factors, dtype=float), targets, robust)


def _noticing(scenarios: list[tuple[Spec, Assembled, float]], notice: Notice):
    """Models with the hidden map among their parameters, the criterion of missing it, and the number of parameters of
    the believed model (None: all, where the sensor has a discrepancy of its own)."""
    models, missing, believed = [], [], None
    for spec, built, _ in scenarios:
        model = built.model
        if where_hidden(model, SCALE_FACTOR) is None:
            believed = model.size
            model = with_hidden(spec, model, SCALE_FACTOR)
        missing.append(hidden_test(model, notice, 0))
        models.append(model)
    return models, missing, believed


def _limit(requirement: Requirement) -> float:
    """The largest allowed value of the limiting statistic, in SI."""
    limit = limit_of(requirement)
    assert limit is not None  # only requirements with a target limit a search
    return limit[1] / UNIT_OF[requirement.quantity][1]


def _criterion(built: Assembled, requirement: Requirement, *, limited: bool = False) -> Criterion:
    """The criterion of a requirement's own statistic or, if `limited`, of the one that its target limits."""
    limit = limit_of(requirement) if limited else None
    criterion = criterion_of(built.model, requirement, None if limit is None else limit[0], _GRID)
    return counted_criterion(criterion, built)


def _optimality(built: Assembled, name: str) -> Optimality:
    model = built.model
    where = model.where(BIAS if model.scale is None else SCALE_FACTOR)
    return Optimality(model.to_reported[where], cast("Any", name[0]))
