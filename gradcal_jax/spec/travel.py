"""Makes a plan fit whose moves exceed the travel of the table: its turns go as far as the travel allows."""

import copy
import math
from collections.abc import Mapping
from typing import Any

from gradcal_jax.spec.bench import TableAxis
from gradcal_jax.spec.motion_plan import BEYOND_TRAVEL, PlanSchedule
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.units import parse, to_unit

_OF_SHAPE = ("turn", "turns", "duration", "ramp", "repeat")


def lies_in_travel(error: SpecError) -> bool:
    """Whether nothing is wrong with a spec but moves beyond the table's travel."""
    return all(problem.kind == BEYOND_TRAVEL for problem in error.problems)


def within_travel(document: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a spec whose moves stay within the travel of every axis: a turn that does not fit goes the other
    way or, where that does not fit either, to the farther end; a pose or the start to the same direction or the nearer
    end; a last turn goes back to where the cycle began. Every turn is as fast as it was."""
    tables: dict[str, Any] = copy.deepcopy(dict(document))
    axes = [TableAxis.model_validate(axis) for axis in tables["rig"]["table"]["axis"]]
    free = copy.deepcopy(tables)
    for axis in free["rig"]["table"]["axis"]:
        axis.pop("travel", None)
        axis.pop("keep_out", None)
    schedule = spec_of(free).schedule
    assert isinstance(schedule, PlanSchedule)
    ends = [(math.ceil(_tenths(low)) / 10.0, math.floor(_tenths(high)) / 10.0) for low, high in (a.reach for a in axes)]
    start = [_towards(to_unit(angle, "deg"), *reach) for angle, reach in zip(schedule.start, ends, strict=True)]
    if any(start) or "start" in tables["plan"]["cycle"]:
        tables["plan"]["cycle"]["start"] = {a.name: f"{at:.6g} deg" for a, at in zip(axes, start, strict=True)}
    here, way, fastest = list(start), [1.0] * len(axes), [""] * len(axes)
    moves: list[dict[str, Any]] = []
    for number, move in enumerate(tables["plan"]["cycle"]["moves"]):
        if "pose" in move:
            for k, axis in enumerate(axes):
                if axis.name in move["pose"]:
                    goal = to_unit(parse(move["pose"][axis.name], "angle"), "deg")
                    here[k] = _towards(goal, *ends[k])
                    move["pose"][axis.name] = f"{here[k]:.6g} deg"
            moves.append(move)
            continue
        steps = [s for s in schedule.steps if s.source == number and s.axis >= 0]
        moves += [] if steps else [move]
        for step in [s for s in steps for _ in range(s.move.repeat)]:
            k, angle, (low, high) = step.axis, to_unit(step.move.angle, "deg"), ends[step.axis]
            if not low <= here[k] + way[k] * angle <= high:
                way[k] = -way[k]
            goal = here[k] + way[k] * angle
            if not low <= goal <= high:
                goal = high if high - here[k] > here[k] - low else low
            kept = {key: value for key, value in move.items() if key not in _OF_SHAPE}
            if kept.get("shape") == "hand":
                kept["duration"] = move["duration"]
            else:
                kept.pop("shape", None)
                kept["peak_rate"] = fastest[k] = f"{to_unit(step.move.fastest, 'deg/s'):.6g} deg/s"
            moves.append({"turn": f"{goal - here[k]:.6g} deg", **kept})
            here[k] = goal
    for k, axis in enumerate(axes):
        if abs(here[k] - start[k]) > 1e-6:
            last = {"turn": f"{start[k] - here[k]:.6g} deg", "axis": axis.name}
            moves.append(last | ({"peak_rate": fastest[k]} if fastest[k] else {}))
    tables["plan"]["cycle"]["moves"] = moves
    return tables


def _tenths(angle: float) -> float:
    return 10.0 * to_unit(angle, "deg") if math.isfinite(angle) else math.copysign(1e9, angle)


def _towards(goal: float, low: float, high: float) -> float:
    """The same direction within the reach (deg), or else the end that is nearer."""
    same = [goal + turns * 360.0 for turns in (0, -1, 1)]
    return next((angle for angle in same if low <= angle <= high), min(max(same[0], low), high))
