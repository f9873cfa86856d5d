"""The spec of one gyro axis in the general form: `[sensor.gyro]` of one axis, along the only axis of a table."""

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

from pydantic import TypeAdapter

from gradcal_jax.files.moves import AXES, Axis, Move, ResolvedMove
from gradcal_jax.files.problems import Problem, SpecError
from gradcal_jax.files.quantity import PositiveAcceleration, Quantity, SizeOfTime
from gradcal_jax.files.spec import Spec, expect_spec
from gradcal_jax.files.unit_spec import UnitSpec, unit_spec_of
from gradcal_jax.formulas import EARTH_RATE

Tables = dict[str, Any]

_OF_IMU: Final = (
    "name", "grade", "thermal_lag", "clock", "sample_clock_error", "temperature_offset", "temperature_lag",
)  # fmt: skip
_OF_TABLE: Final = ("drive", "answer_time", "rate_accuracy")
# The body's axes on a table whose axis points up: the gyro's own is along it.
_MOUNTINGS: Final[Mapping[str, Tables]] = {
    "x": {"x": "+z", "y": "+x", "z": "+y"},
    "y": {"x": "+y", "y": "+z", "z": "+x"},
    "z": {"x": "+x", "y": "+y", "z": "+z"},
}
_NO_SUCH_TABLE: Final = (
    "turns sensor axes {} as if each had a table of its own; no gimbal does: take a table of two axes "
    "(gradcal new two-axis-table)"
)
_SECONDS: Final = "s"


def general(spec: Spec | UnitSpec) -> UnitSpec:
    """A spec in the general form. Errors: `SpecError` for a plan that turns several axes of a sensor, `TypeError` for
    anything but a spec."""
    if isinstance(spec, UnitSpec):
        return spec
    return unit_spec_of(axis_as_imu(expect_spec(spec).model_dump(mode="json", exclude_unset=True)))


def axis_as_imu(document: Mapping[str, Any], axis: Axis | None = None) -> Tables:
    """The tables of a one-axis spec as those of an IMU of one gyro, which predict the same; not validated.

    `axis`: of a plan that turns several, the one whose gyro is seen; moves of the others are rests. Errors: `SpecError`
    for a plan that turns several axes, without `axis`, and for moves that are not determined.
    """
    spec = copy.deepcopy(dict(document))
    turned = turned_axes(spec)
    if axis is None and len(turned) > 1:
        raise SpecError([Problem(("plan", "cycle", "moves"), _NO_SUCH_TABLE.format(", ".join(turned)))])
    seen = axis or turned[0]
    sensor, rig = spec["sensor"], spec["rig"]
    table = dict(rig["table"])
    plan, every = _plan(spec["plan"], seen, rig["table"])
    result: Tables = {key: spec[key] for key in ("format", "title") if key in spec}
    result["sensor"] = _sensor(sensor, seen)
    common = {key: table.pop(key) for key in _OF_TABLE if key in table}
    mounting = _MOUNTINGS[seen] | ({"accuracy": table.pop("mounting_accuracy")} if "mounting_accuracy" in table else {})
    turn = {"name": seen, "direction": [0.0, 0.0, 1.0], **table}
    turn["angle"] = table.get("angle", {}) | {"read_every": every}
    result["rig"] = {key: rig[key] for key in ("name", "chamber", "resolution") if key in rig}
    result["rig"]["table"] = {"standing": "read", **common, "axis": [turn], "mounting": mounting}
    if "earth_rate" in rig:
        result["rig"]["site"] = {"latitude": _latitude(rig["earth_rate"])}
    result["requirement"] = [_requirement(row, seen) for row in spec.get("requirement", ())]
    result["plan"] = plan
    if "design" in spec:
        result["design"] = _design(spec["design"])
    if "done" in spec:
        result["done"] = [part | {"plan": _plan(part["plan"], seen, rig["table"])[0]} for part in spec["done"]]
    return result


def turned_axes(document: Mapping[str, Any]) -> Sequence[Axis]:
    """The sensor axes that a spec's plan turns, in order; x for one that stands."""
    moves = document["plan"].get("cycle", {}).get("moves", ())
    return tuple(dict.fromkeys(move.get("axis", AXES[0]) for move in moves if "rest" not in move)) or AXES[:1]


def _sensor(sensor: Tables, axis: Axis) -> Tables:
    imu = {key: sensor[key] for key in _OF_IMU if key in sensor}
    gyro = {"axes": [axis]} | {k: v for k, v in sensor.items() if k not in (*_OF_IMU, "quantity", "uncertain")}
    uncertain = sensor.get("uncertain")
    if isinstance(uncertain, str):
        gyro["uncertain"] = imu["uncertain"] = uncertain
    elif uncertain is not None:
        for of, keys in ((imu, _OF_IMU), (gyro, set(uncertain) - set(_OF_IMU))):
            if own := {key: uncertain[key] for key in uncertain if key in keys}:
                of["uncertain"] = own
    return imu | {"gyro": gyro}


def _design(design: Tables) -> Tables:
    """The scenarios change keys where they are in the general form."""
    if "scenario" not in design:
        return design
    return design | {"scenario": [_scenario(scenario) for scenario in design["scenario"]]}


def _scenario(scenario: Tables) -> Tables:
    sensor, rig = dict(scenario.get("sensor", {})), dict(scenario.get("rig", {}))
    result = {key: scenario[key] for key in ("name", "weight") if key in scenario}
    if sensor:
        of_imu, gyro = ({k: v for k, v in sensor.items() if (k in _OF_IMU) == own} for own in (True, False))
        result["sensor"] = of_imu | ({"gyro": gyro} if gyro else {})
    if rig:
        table = dict(rig.pop("table", {}))
        common = {key: table.pop(key) for key in _OF_TABLE if key in table}
        if "mounting_accuracy" in table:
            common["mounting[0]"] = {"accuracy": table.pop("mounting_accuracy")}
        if "earth_rate" in rig:
            rig["site"] = {"latitude": _latitude(rig.pop("earth_rate"))}
        result["rig"] = rig | ({"table": common | ({"axis[0]": table} if table else {})} if common or table else {})
    return result


def _latitude(earth_rate: str) -> str:
    """Where an axis that points up has this rate of the Earth."""
    if earth_rate == "unknown":
        return earth_rate
    sine = Quantity.read(earth_rate, "angular rate") / EARTH_RATE
    return Quantity.of(math.asin(max(-1.0, min(sine, 1.0))), "deg").text


def _requirement(row: Tables, axis: Axis) -> Tables:
    """Requirements on a map are on that of the gyro; all others are as they are."""
    of_maps = row.get("quantity") in ("bias", "scale_factor")
    return row | ({"quantity": f"gyro_{row['quantity']}", "axis": axis} if of_maps else {})


def _plan(plan: Tables, axis: Axis, table: Tables) -> tuple[Tables, str]:
    """The plan, and the spacing of the table's readings where the plan does not say it."""
    every: str = plan.get("read_every", "rest")
    plan = {key: value for key, value in plan.items() if key not in ("read_every", "reference")}
    if "cycle" not in plan:
        return plan, every
    cycle = plan["cycle"]
    moves: list[Tables] = cycle["moves"]
    of_others: Tables = {"read": "none"}
    spacings = [move["read_every"] for move in moves if "rest" in move and "read_every" in move]
    every = next(iter(spacings), "rest")
    others = cycle.get("other_axes", {})
    if others.get("read"):
        every = others.setdefault("read_every", every)
        of_others = {"read_every": every}
    cycle["moves"] = [_move(move, axis, of_others, table) for move in moves]
    return plan, every


def _move(move: Tables, axis: Axis, of_others: Tables, table: Tables) -> Tables:
    plain = {key: value for key, value in move.items() if key != "axis"}
    if "rest" in move:
        return plain if {"read", "read_every"} & set(move) else plain | {"read": "end"}
    if move.get("axis", AXES[0]) == axis:
        return plain
    limit = TypeAdapter(PositiveAcceleration).validate_python(table["max_acceleration"])
    answer_time = TypeAdapter(SizeOfTime).validate_python(table.get("answer_time", "0 s"))
    resolved: ResolvedMove = cast("Any", TypeAdapter(Move).validate_python(move)).resolve(float(limit))
    lasts = resolved.answered(float(answer_time)).duration
    repeated = {"repeat": move["repeat"]} if "repeat" in move else {}
    return {"rest": Quantity.of(lasts, _SECONDS).text, **repeated, **of_others}
