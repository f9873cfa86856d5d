"""Predictions of the recipe's plan for other times, encoders and slopes on a small grid, for the panel.

The grid has factors on the chamber's slope, numbers of ramps (there, back, there …, which is the time), and factors on
every figure of the angle. The panel shows only grid points, so that each of its numbers is a prediction and none is
interpolated. A point to which the plan does not fit (a cycle longer than its ramp, a slope beyond the chamber's) has
none.
"""

import math
from collections.abc import Mapping
from itertools import product
from typing import Any, Final

from gradcal_jax import api
from gradcal_jax.files import Spec, SpecError, changed
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.recipe import Recipe
from gradcal_jax.files.unit_plan import UnitPlan
from gradcal_jax.pages.numbers import figures
from gradcal_jax.units import time_text

SLOPES: Final = (0.5, 0.7, 1.0, 1.4, 2.0)
RAMPS: Final = (1, 2, 3)
ANGLES: Final = (0.25, 0.5, 1.0, 2.0, 4.0)
_ANGLE: Final = "rig.table.angle"


def panel_of(recipe: Recipe) -> dict[str, Any]:
    """The panel's numbers: `choices` by slider, and by grid point (slopes slow, angles fast) the time in hours and the
    requirements' values and verdicts; null where the plan does not fit or a requirement is not observable.

    Errors: `ValueError` for a plan that is not one ramp from start to end.
    """
    spec = recipe.axis_spec
    plan = spec.plan
    if not isinstance(plan, UnitPlan) or plan.temperature is None or not isinstance(plan.gradient, Quantity):
        raise ValueError("the panel varies the slope of one ramp, and this plan is not one ramp: leave --panel out")
    points = [_point(spec, plan, *at) for at in product(SLOPES, RAMPS, ANGLES)]
    rows = recipe.prediction.requirements
    kept = [row for row in rows if row.axis == rows[0].axis]
    minute = 60.0 * float(plan.gradient)
    return {
        "choices": [
            {"name": "chamber slope", "labels": [f"{figures(f * minute, 3)} K/min" for f in SLOPES], "own": 2},
            {"name": "time", "labels": [f"{n} ramp{'s' * (n > 1)}" for n in RAMPS], "own": 0},
            {"name": "encoder", "labels": [_angle_label(spec, factor) for factor in ANGLES], "own": 2},
        ],
        "hours": [None if p is None else p[0] for p in points],
        "lasts": [None if p is None else time_text(3600.0 * p[0]) for p in points],
        "requirements": [
            {
                "name": f"{row.name} ({row.statistic})",
                "unit": row.unit,
                "target": row.target,
                # The limit on one standard deviation.
                "allowed": None if row.target is None else row.target / row.coverage,
                # Six digits are more than the panel shows.
                "values": [None if p is None or p[1][k][0] is None else float(f"{p[1][k][0]:.6g}") for p in points],
                "verdicts": [None if p is None else p[1][k][1] for p in points],
            }
            for k, row in enumerate(kept)
        ],
    }


def _point(
    spec: Spec, plan: UnitPlan, slope: float, ramps: int, angle: float
) -> tuple[float, list[tuple[float | None, str | None]]] | None:
    """Hours of the whole plan, and of each requirement its value and verdict; None where the plan does not fit."""
    try:
        varied = changed(spec, {**_course(plan, slope, ramps), **_angles(spec, angle)})
    except SpecError:
        return None
    rows = api.predict(varied).requirements
    first = [row for row in rows if row.axis == rows[0].axis]
    return varied.schedule.duration / 3600.0, [(row.judged, row.verdict) for row in first]


def _course(plan: UnitPlan, slope: float, ramps: int) -> Mapping[str, object]:
    assert plan.temperature is not None
    assert isinstance(plan.gradient, Quantity)
    rate = f"{60.0 * float(plan.gradient) * slope:.9g} K/min"
    if ramps == 1:
        return {"plan.gradient": rate}
    start, end = (t.text for t in plan.temperature)
    # A programme begins with a soak; of a plan without one, the shortest.
    soak = {"soak": "1 s", "at": start}
    if plan.soak is not None:
        soak = {"soak": plan.soak.duration.text, "at": start, "used": plan.soak.used}
    items = [soak, *({"ramp_to": (end, start)[k % 2], "rate": rate} for k in range(ramps))]
    return {"plan.temperature": None, "plan.gradient": None, "plan.soak": None, "plan.programme": items}


def _angles(spec: Spec, factor: float) -> Mapping[str, object]:
    angle = spec.rig.table.angle
    sizes = {"reading_noise": angle.reading_noise, "standstill_offset": angle.standstill_offset}
    changes = {f"{_ANGLE}.{name}": factor * float(size) for name, size in sizes.items() if size}
    changes |= {
        f"{_ANGLE}.harmonics[{k}].amplitude": factor * float(h.amplitude) for k, h in enumerate(angle.harmonics)
    }
    return {key: Quantity.of(value, "urad").text for key, value in changes.items()}


def _angle_label(spec: Spec, factor: float) -> str:
    """The label of an encoder, by its largest figure."""
    angle = spec.rig.table.angle
    largest = max(float(angle.reading_noise), float(angle.standstill_offset))
    shown = factor * math.degrees(largest)
    return f"{figures(shown, 3)} deg" if shown >= 0.01 else f"{figures(3600.0 * shown, 3)} arcsec"
