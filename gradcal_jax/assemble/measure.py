"""What a design minimises, from a spec: one number of a plan, and by how much it exceeds the other targets."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax import plans
from gradcal_jax.assemble.build import Assembled, assemble
from gradcal_jax.assemble.knowledge import UNIT_OF, box
from gradcal_jax.design import Criterion, Optimality, criterion
from gradcal_jax.files import Spec, changed
from gradcal_jax.files.design import OPTIMALITIES, TIMES, Design, Scenario
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.information import information, to_reported

# The search sees a requirement's box on a grid of at most this many temperatures and rates.
_GRID = 41


class Measure(NamedTuple):
    """`of(plan, sharpness)`: the value in `unit`, and the logarithms by which limits are exceeded (k,).

    `name`: what is minimised, as people call it. `limits`: names of the requirements whose targets are limits.
    """

    of: Callable[[plans.Plan, Array | None], tuple[Float[Array, ""], Float[Array, " k"]]]
    name: str
    unit: str
    limits: tuple[str, ...]


def design_of(spec: Spec) -> Design:
    """The spec's [design]. Errors: `ValueError` where it has none."""
    if spec.design is None:
        raise ValueError('the spec has no [design]: say what to minimise and what is free, such as minimise = "…"')
    return spec.design


def measure(spec: Spec) -> Measure:
    """What the spec's [design] minimises; for a time, the requirement with a target that is farthest from it."""
    design = design_of(spec)
    if design.whole_turns:
        # Whole turns cancel what repeats with the angle; before the turns are whole, it only hides the way.
        spec = changed(spec, {"rig.table.angle.harmonics": None})
    scenarios = _scenarios(spec, design)
    limiting = [r for r in spec.requirement if r.target is not None and r.name != design.minimise]
    if design.minimise in TIMES:
        if not limiting:
            raise ValueError(f'"{design.minimise}" is minimised under targets: give a requirement a target')
        name, unit = "residual over target", "of the target"
        mains = [[_criterion(built, r) for r in limiting] for built, _ in scenarios]
        factors = [1.0 / float(r.target) for r in limiting if r.target is not None]
        limiting = []
    elif design.minimise in OPTIMALITIES:
        name, unit = design.minimise, "ppm" if spec.sensor.scale_factor is not None else "deg/h"
        mains = [[_optimality(built, design.minimise)] for built, _ in scenarios]
        factors = [UNIT_OF["scale_factor" if unit == "ppm" else "bias"][1]]
    else:
        main = next(r for r in spec.requirement if r.name == design.minimise)
        unit, factor = UNIT_OF[main.quantity]
        name = f"{main.name} ({main.statistic})"
        mains, factors = [[_criterion(built, main)] for built, _ in scenarios], [factor]
    limits = [[_criterion(built, r) for r in limiting] for built, _ in scenarios]
    targets = np.array([float(cast("float", r.target)) for r in limiting])
    weights = np.array([weight for _, weight in scenarios])

    def of(plan: plans.Plan, sharpness: Array | None):
        values, excesses = [], []
        for (built, _), main, limit in zip(scenarios, mains, limits, strict=True):
            lag = None if built.thermal_lag is None else jnp.asarray(built.thermal_lag)
            info = information(plan.timeline(plan.channels[0], lag), built.model)
            each = jnp.stack([c(info, sharpness) * f for c, f in zip(main, factors, strict=True)])
            values.append(_worst(each, sharpness))
            excesses += [c(info, sharpness) / t for c, t in zip(limit, targets, strict=True)]
        together = jnp.stack(values)
        if design.robust == "worst":
            value = _worst(together, sharpness)
        else:
            value = jnp.sum(together * weights) / np.sum(weights)
        return value, jnp.log(jnp.stack(excesses)) if excesses else jnp.zeros(0)

    return Measure(of, name, unit, tuple(r.name for r in limiting))


def _worst(values: Array, sharpness: Array | None) -> Array:
    """The largest, or a norm just above it."""
    if values.shape[0] == 1:
        return values[0]
    top = jnp.max(values)
    return top if sharpness is None else top * jnp.sum((values / top) ** sharpness) ** (1.0 / sharpness)


def _scenarios(spec: Spec, design: Design) -> list[tuple[Assembled, float]]:
    """Sensors and rigs that the plan must serve, with their weights; the spec's own where there are none."""
    if not design.scenario:
        return [(assemble(spec), 1.0)]
    return [(assemble(changed(spec, overrides(s))), float(s.weight)) for s in design.scenario]


def overrides(scenario: Scenario) -> dict[str, Any]:
    """A scenario's values by their dotted keys."""
    return dict(_leaves({"sensor": scenario.sensor, "rig": scenario.rig}, ""))


def _leaves(tables: dict[str, Any], before: str):
    for name, value in tables.items():
        key = f"{before}.{name}" if before else name
        if isinstance(value, dict):
            yield from _leaves(value, key)
        else:
            yield key, value


def _criterion(built: Assembled, requirement: Requirement) -> Criterion:
    temperature, rate = box(requirement, _GRID)
    return criterion(built.model, requirement.quantity, temperature, rate, requirement.statistic)


def _optimality(built: Assembled, name: str) -> Optimality:
    model = built.model
    where = model.columns.bias if model.scale is None else model.columns.scale
    return Optimality(jnp.asarray(to_reported(model)[where.start : where.stop]), cast("Any", name[0]))
