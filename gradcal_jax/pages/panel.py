"""Predictions of a plan for other times, encoders and slopes on a small grid, for the panel.

The grid has factors on the chamber's slope, numbers of ramps (there, back, there …, which is the time), and factors on
every figure of the angles of all axes. The panel shows only grid points, so that each of its numbers is a prediction
and none is interpolated. A point to which the plan does not fit (a cycle longer than its ramp, a slope beyond the
chamber's) has none.
"""

import math
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any, Final

from gradcal_jax.api.prediction import requirement_rows
from gradcal_jax.files.bench import AxisEncoder
from gradcal_jax.files.changes import changed
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.motion_plan import MotionPlan
from gradcal_jax.files.problems import SpecError
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.pages.numbers import figures
from gradcal_jax.units import time_text

SLOPES: Final = (0.5, 0.7, 1.0, 1.4, 2.0)
RAMPS: Final = (1, 2, 3)
ANGLES: Final = (0.25, 0.5, 1.0, 2.0, 4.0)


def panel_of(spec: Spec) -> dict[str, Any]:
    """The panel's numbers: `choices` by slider, and by grid point (slopes slow, angles fast) the time in hours and the
    requirements' values and verdicts; null where the plan does not fit or a requirement is not observable.

    Errors: `ValueError` for a plan that is not one ramp from start to end, or without requirements.
    """
    plan = spec.plan
    if not isinstance(plan, MotionPlan) or plan.temperature is None or not isinstance(plan.gradient, Quantity):
        raise ValueError("the panel varies the slope of one ramp, and this plan is not one ramp: leave --panel out")
    if not spec.requirement:
        raise ValueError("the panel shows requirements, and this spec has none: leave --panel out")
    points = [_point(spec, plan, *at) for at in product(SLOPES, RAMPS, ANGLES)]
    minute = 60.0 * float(plan.gradient)
    own = points[2 * len(RAMPS) * len(ANGLES) + 2]
    assert own is not None
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
                "values": [None if p is None else _short(p[1][k].judged) for p in points],
                "verdicts": [None if p is None else p[1][k].verdict for p in points],
            }
            for k, row in enumerate(own[1])
        ],
    }


def _point(
    spec: Spec, plan: MotionPlan, slope: float, ramps: int, angle: float
) -> tuple[float, list[RequirementRow]] | None:
    """Hours of the whole plan, and every requirement; None where the plan does not fit."""
    try:
        varied = changed(spec, {**_course(plan, slope, ramps), **_angles(spec, angle)})
    except SpecError:
        return None
    return varied.schedule.duration / 3600.0, requirement_rows(varied)


def _short(value: float | None) -> float | None:
    """Six digits, more than the panel shows."""
    return None if value is None else float(f"{value:.6g}")


def _course(plan: MotionPlan, slope: float, ramps: int) -> Mapping[str, object]:
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
    """Every figure of the axes' angles, times a factor."""
    return {
        f"rig.table.axis[{k}].angle.{key}": Quantity.of(factor * size, "urad").text
        for k, axis in enumerate(spec.rig.table.axis)
        for key, size in _figures(axis.angle)
    }


def _figures(angle: AxisEncoder) -> Iterator[tuple[str, float]]:
    """The figures of an angle that are stated and not zero (rad), by their keys."""
    for name in ("reading_noise", "standstill_offset"):
        if size := float(getattr(angle, name)):
            yield name, size
    for k, harmonic in enumerate(angle.harmonics):
        yield f"harmonics[{k}].amplitude", float(harmonic.amplitude)


def _angle_label(spec: Spec, factor: float) -> str:
    """The label of an encoder, by its largest figure."""
    sizes = (size for axis in spec.rig.table.axis for _, size in _figures(axis.angle))
    shown = factor * math.degrees(max(sizes, default=0.0))
    return f"{figures(shown, 3)} deg" if shown >= 0.01 else f"{figures(3600.0 * shown, 3)} arcsec"
