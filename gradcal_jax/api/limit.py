"""The proven lower limit on any plan with the rig and time of a spec, and the efficiency of the spec's plan."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.api.axis_limit import proofs_of_axis
from gradcal_jax.api.imu_limit import proofs_of_imu
from gradcal_jax.api.imu_residual import imu_residual
from gradcal_jax.api.prediction import requirement_rows
from gradcal_jax.api.structures import with_motion
from gradcal_jax.api.systematic import floor_of_plan
from gradcal_jax.api.verdicts import UNIT_OF
from gradcal_jax.display import summary
from gradcal_jax.files.absent import with_typical
from gradcal_jax.files.spec import expect_spec, goes_on
from gradcal_jax.files.spec_sections import Spec


class PlanLimit(NamedTuple):
    """No plan leaves less than `certified` (`unit`) of a requirement; `reached`: the optimum of the relaxed problem.

    `value`: what the spec's plan leaves (None: not observable); `efficiency`: certified over value. `relaxed`: limits
    of the rig that the proof leaves out; `kept`: what all plans of the proof have in common; both in words. All of that
    is by the terms that the spec names; `counted`, `judged`: certified and value with those that it omits, at typical
    figures.
    """

    name: str
    statistic: str
    unit: str
    certified: float
    reached: float
    value: float | None
    efficiency: float | None
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]
    counted: float
    judged: float | None

    __repr__ = summary


def limits(spec: Spec, *, motion: float | None = None) -> list[PlanLimit]:
    """The limit of every requirement of a gradient plan for which there is a proof.

    `motion` s: time without soaks, in the place of the plan's or [design]'s; values and efficiencies are the plan's.
    Errors: `ValueError` where there is no requirement, no proof for one, or another kind of plan.
    """
    spec = expect_spec(spec)
    if spec.done:
        raise goes_on("a limit")
    if not spec.requirement:
        raise ValueError("a limit is proven for requirements; the spec has none: add a [[requirement]]")
    if spec.turns_one_gyro and spec.gradient_schedule.steps:
        proofs = proofs_of_axis(spec, motion)
    else:
        proofs = proofs_of_imu(spec if motion is None else with_motion(spec, motion))
    rows = {row.name: row for row in requirement_rows(spec)}
    # What no residual shows, no plan removes: it adds in quadrature, at least its smallest value in the box.
    floors = [floor_of_plan(one) for one in (spec, with_typical(spec))]
    proven: list[PlanLimit] = []
    for r, certified, reached, relaxed, kept in proofs:
        unit, factor = UNIT_OF[r.quantity]
        row, named, every = rows[r.name], 0.0, 0.0
        if r.quantity != "heading":
            named, every = (float(np.min(imu_residual(of, floor, r).values)) for of, floor in floors)
        found, best, counted = (
            float(np.hypot(factor * value, floor))
            for value, floor in ((certified, named), (reached, named), (certified, every))
        )
        share = None if row.decisive is None else found / row.decisive
        proven.append(
            PlanLimit(r.name, r.statistic, unit, found, best, row.decisive, share, relaxed, kept, counted, row.judged)
        )
    return proven
