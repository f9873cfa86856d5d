"""The spec of one gyro axis, as earlier versions wrote it, in the general form: `[sensor.gyro]` of one axis, along the
only axis of a table.

Tables are converted before they are validated, so what is wrong in them stays wrong; `keys_of_axis` gives a problem the
key that the file has. What a file of one axis may not have, and the general form may, are problems of the conversion.
"""

import contextlib
import copy
import math
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, cast

from pydantic import TypeAdapter, ValidationError

from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.spec.moves import AXES, Axis, Move, ResolvedMove, choose_move
from gradcal_jax.tables.problems import Key, Problem, SpecError, from_validation, hint
from gradcal_jax.tables.quantity import EarthRate, PositiveAcceleration, Quantity, SizeOfTime, Time

Tables = dict[str, Any]

_OF_IMU: Final = (
    "name", "grade", "thermal_lag", "clock", "sample_clock_error", "temperature_offset", "temperature_lag",
    "second_thermometer",
)  # fmt: skip
_OF_TABLE: Final = ("drive", "answer_time", "rate_accuracy")
_OF_AXIS: Final = ("max_rate", "max_acceleration", "travel", "angle", "keep_out")
_PARTS: Final = ("gyro", "accelerometer", "frame", "uncertain")
# The body's axes on a table whose axis points up: the gyro's own is along it.
_MOUNTINGS: Final[Mapping[str, Tables]] = {
    "x": {"x": "+z", "y": "+x", "z": "+y"},
    "y": {"x": "+y", "y": "+z", "z": "+x"},
    "z": {"x": "+x", "y": "+y", "z": "+z"},
}
_NO_SUCH_TABLE: Final = (
    "turns sensor axes {} as if each had a separate table; no real table moves in this way: use a table of two axes "
    "(gradcal new two-axis-table)"
)
_SECONDS: Final = "s"


@contextmanager
def _collected(problems: list[Problem], *key: str | int) -> Generator[None]:
    """Context that adds its problems, with keys relative to `key`, to others."""
    try:
        yield
    except SpecError as error:
        problems += [problem.under(*key) for problem in error.problems]


def is_of_axis(document: Mapping[str, Any]) -> bool:
    """Whether tables are the spec of one gyro axis: its figures stand in [sensor] and [rig.table] themselves."""
    sensor, table = _table(document.get("sensor")), _table(_table(document.get("rig")).get("table"))
    general = {"gyro", "accelerometer"} & set(sensor) or {"axis", "mounting", "standing"} & set(table)
    return bool(sensor or table) and not general


def convert(document: Mapping[str, Any], axis: Axis | None = None) -> tuple[Tables, list[Problem]]:
    """The tables of a one-axis spec as those of an IMU of one gyro, which predict the same; not validated. With the
    problems of the conversion, whose keys are those of the file: a plan that turns several axes, without `axis`, and
    what a file of one axis may not have.

    `axis`: of a plan that turns several, the one whose gyro is seen; moves of the others are rests.
    """
    spec = copy.deepcopy(dict(document))
    problems: list[Problem] = []
    turned = turned_axes(spec)
    if axis is None and len(turned) > 1:
        problems.append(Problem(("plan", "cycle", "moves"), _NO_SUCH_TABLE.format(", ".join(turned))))
    seen = axis or turned[0]
    rig = _table(spec.get("rig"))
    table = dict(_table(rig.get("table")))
    plan, every = _plan(spec.get("plan"), seen, table, problems)
    of_rig = {key: value for key, value in rig.items() if key != "earth_rate"}
    if _is_table(rig.get("table")):
        of_rig["table"] = _table_of(table, seen, every)
    if "earth_rate" in rig:
        of_rig["site"] = {"latitude": "unknown"}
        with _collected(problems):
            of_rig["site"] = {"latitude": _latitude(rig["earth_rate"])}
    sensor = _table(spec.get("sensor"))
    if (quantity := sensor.get("quantity", "gyro")) != "gyro":
        message = 'expected "gyro": a spec of one axis is for a gyro; accelerometers belong in [sensor.accelerometer]'
        problems.append(Problem(("sensor", "quantity"), message + hint(quantity, ["gyro"]), quantity))
    own: Tables = {"sensor": _sensor(sensor, seen), "rig": of_rig, "plan": plan}
    result = spec | {name: value for name, value in own.items() if _is_table(spec.get(name))}
    if isinstance(rows := spec.get("requirement"), list):
        result["requirement"] = [_requirement(row, seen) for row in cast("list[Any]", rows)]
    if _is_table(design := spec.get("design")):
        with _collected(problems):
            result["design"] = _design(_table(design))
    if isinstance(parts := spec.get("done"), list):
        done: list[Tables] = []
        for number, part in enumerate(cast("list[Any]", parts)):
            of_part: list[Problem] = []
            plan = _plan(_table(part).get("plan"), seen, table, of_part)[0]
            done.append(_table(part) | {"plan": plan})
            problems += [problem.under("done", number) for problem in of_part]
        result["done"] = done
    return result, problems


def keys_of_axis(problem: Problem) -> Problem:
    """A problem of converted tables, with the key that the file of one axis has."""
    key: Key
    match problem.key:
        case ("sensor", "gyro", *rest):
            key = ("sensor", *rest)
        case ("rig", "table", "mounting", *_, "accuracy"):
            key = ("rig", "table", "mounting_accuracy")
        case ("rig", "table", "axis", 0, "angle", "read_every"):
            key = ("plan", "read_every")
        case ("rig", "table", "axis", 0, *rest):
            key = ("rig", "table", *rest)
        case ("rig", "site", *_):
            key = ("rig", "earth_rate")
        case _:
            return problem
    return replace(problem, key=key)


def change_of_imu(tables: Mapping[str, Any], key: Key, value: object) -> tuple[Key, object]:
    """The key and the value of the general form for ones of a spec of one axis, where an IMU of `tables` is one."""
    sensor, table = tables.get("sensor", {}), tables.get("rig", {}).get("table", {})
    match key:
        case ("sensor", str() as name, *rest) if name not in (*_OF_IMU, *_PARTS) and {"gyro"} == set(sensor) & {
            "gyro",
            "accelerometer",
        }:
            return ("sensor", "gyro", name, *rest), value
        case ("rig", "table") if _is_table(value) and "axis" not in _table(value) and len(table.get("axis", ())) == 1:
            (axis,) = table["axis"]
            return key, _table_of(_table(value), axis["name"], axis.get("angle", {}).get("read_every", "1 s"))
        case ("rig", "earth_rate"):
            return ("rig", "site", "latitude"), value if value is None else _latitude(value)
        case ("rig", "table", "mounting_accuracy"):
            first = (0,) if "mounting" in table else ()
            return ("rig", "table", "mounting", *first, "accuracy"), value
        case ("rig", "table", str() as name, *rest) if name in _OF_AXIS and len(table.get("axis", ())) == 1:
            return ("rig", "table", "axis", 0, name, *rest), value
        case _:
            return key, value


def turned_axes(document: Mapping[str, Any]) -> Sequence[Axis]:
    """The sensor axes that a spec's plan turns, in order; x for one that stands."""
    moves = _moves_of(_table(document.get("plan")))
    turned = (_table(move).get("axis", AXES[0]) for move in moves if "rest" not in _table(move))
    return tuple(name for name in dict.fromkeys(turned) if name in AXES) or AXES[:1]


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping)


def _table(value: object) -> Tables:
    """The value where it is a table; what is none is found when the spec is validated."""
    return dict(cast("Tables", value)) if isinstance(value, Mapping) else {}


def _moves_of(plan: Tables) -> list[Any]:
    moves = _table(plan.get("cycle")).get("moves")
    return cast("list[Any]", moves) if isinstance(moves, list) else []


def _sensor(of_file: Tables, axis: Axis) -> Tables:
    imu = {key: of_file[key] for key in _OF_IMU if key in of_file}
    gyro = {"axes": [axis]} | {k: v for k, v in of_file.items() if k not in (*_OF_IMU, "quantity", "uncertain")}
    uncertain = of_file.get("uncertain")
    if _is_table(uncertain):
        of = _table(uncertain)
        for part, keys in ((imu, _OF_IMU), (gyro, set(of) - set(_OF_IMU))):
            if own := {key: of[key] for key in of if key in keys}:
                part["uncertain"] = own
    elif uncertain is not None:
        gyro["uncertain"] = imu["uncertain"] = uncertain
    return imu | {"gyro": gyro}


def _table_of(table: Tables, axis: Axis, every: Any) -> Tables:
    common = {key: table.pop(key) for key in _OF_TABLE if key in table}
    mounting = _MOUNTINGS[axis] | ({"accuracy": table.pop("mounting_accuracy")} if "mounting_accuracy" in table else {})
    angle = table.get("angle", {})
    turn = {"name": axis, "direction": [0.0, 0.0, 1.0], **table}
    turn["angle"] = _table(angle) | {"read_every": every} if _is_table(angle) else angle
    return {"standing": "read", **common, "axis": [turn], "mounting": [mounting]}


def _design(design: Tables) -> Tables:
    """The scenarios change keys where they are in the general form."""
    if not isinstance(rows := design.get("scenario"), list):
        return design
    return design | {"scenario": [_scenario(_table(row)) if _is_table(row) else row for row in cast("list[Any]", rows)]}


def _scenario(scenario: Tables) -> Tables:
    sensor, rig = _table(scenario.get("sensor")), _table(scenario.get("rig"))
    result = {key: value for key, value in scenario.items() if key not in ("sensor", "rig")}
    if sensor:
        of_imu, gyro = ({k: v for k, v in sensor.items() if (k in _OF_IMU) == own} for own in (True, False))
        result["sensor"] = of_imu | ({"gyro": gyro} if gyro else {})
    if rig:
        table = _table(rig.pop("table", None))
        common = {key: table.pop(key) for key in _OF_TABLE if key in table}
        if "mounting_accuracy" in table:
            common["mounting[0]"] = {"accuracy": table.pop("mounting_accuracy")}
        if "earth_rate" in rig:
            rig["site"] = {"latitude": _latitude(rig.pop("earth_rate"))}
        result["rig"] = rig | ({"table": common | ({"axis[0]": table} if table else {})} if common or table else {})
    return result


def _latitude(earth_rate: object) -> object:
    """Where an axis that points up has this rate of the Earth."""
    if earth_rate == "unknown":
        return earth_rate
    try:
        rate = TypeAdapter(EarthRate).validate_python(earth_rate)
    except ValidationError as error:
        raise SpecError(problem.under("rig", "earth_rate") for problem in from_validation(error)) from None
    return Quantity.of(math.asin(max(-1.0, min(rate / EARTH_RATE, 1.0))), "deg").text


_QUANTITIES: Final[Mapping[str, str]] = {
    "bias": "gyro_bias",
    "scale_factor": "gyro_scale_factor",
    "heading": "mission_heading",
}


def _requirement(row: Any, axis: Axis) -> Any:
    """The requirement on the gyro, by the quantity's general name."""
    if not _is_table(row):
        return row
    quantity = _table(row).get("quantity", "")
    return _table(row) | {"quantity": _QUANTITIES.get(quantity, quantity), "axis": axis}


def _plan(of_file: object, axis: Axis, table: Tables, problems: list[Problem]) -> tuple[Any, Any]:
    """The plan, and the spacing of the table's readings where the plan does not say it."""
    if not _is_table(of_file):
        return of_file, "rest"
    plan = _table(of_file)
    if (reference := plan.pop("reference", "angle")) != "angle":
        problems.append(Problem(("plan", "reference"), 'expected "angle"', reference))
    every = plan.pop("read_every", None)
    if plan.get("method") == "gradient" and "cycle" not in plan and every is None:
        message = (
            'this key is missing: if there is no cycle, it states how often the axis is read at rest, such as "1 s"'
        )
        problems.append(Problem(("plan", "read_every"), message, kind="missing"))
    if "cycle" in plan and every is not None:
        message = "if there is a cycle, its moves state when the axis is read; leave this key out"
        problems.append(Problem(("plan", "read_every"), message, every))
    if not _is_table(plan.get("cycle")) or not (moves := _moves_of(plan)):
        return plan, every or "rest"
    cycle = plan["cycle"] = _table(plan["cycle"])
    of_others: Tables = {"read": "none"}
    spacings = [_table(move)["read_every"] for move in moves if {"rest", "read_every"} <= set(_table(move))]
    every = next(filter(_is_time, spacings), "rest")
    if (others := _table(cycle.get("other_axes"))).get("read"):
        if not spacings and "read_every" not in others:
            message = "this key is missing, and no rest of the cycle states how often the axis is read"
            problems.append(Problem(("plan", "cycle", "other_axes", "read_every"), message, kind="missing"))
        every = others.get("read_every", every)
        of_others = {"read_every": every} if _is_time(every) else {}
        cycle["other_axes"] = others | of_others
    converted: list[Any] = []
    for i, move in enumerate(moves):
        with _collected(problems, "plan", "cycle", "moves", i):
            converted.append(_move(_table(move), axis, of_others, table) if _is_table(move) else move)
    if len(converted) == len(moves):
        cycle["moves"] = converted
    else:
        del plan["cycle"]
    return plan, every if _is_time(every) else "rest"


def _is_time(value: object) -> bool:
    with contextlib.suppress(ValidationError):
        return bool(TypeAdapter(Time).validate_python(value))
    return False


def _move(move: Tables, axis: Axis, of_others: Tables, table: Tables) -> Tables:
    plain = {key: value for key, value in move.items() if key != "axis"}
    if "rest" in move:
        return plain if {"read", "read_every"} & set(move) else plain | {"read": "end"}
    if "shape" not in move:
        choose_move(move)
    if (of := move.get("axis", AXES[0])) == axis:
        return plain
    if of not in AXES:
        return move
    try:
        limit = TypeAdapter(PositiveAcceleration).validate_python(table.get("max_acceleration"))
        answer_time = TypeAdapter(SizeOfTime).validate_python(table.get("answer_time", "0 s"))
        resolved: ResolvedMove = cast("Any", TypeAdapter(Move).validate_python(plain)).resolve(float(limit))
    except ValidationError:
        return move
    lasts = resolved.answered(float(answer_time)).duration
    repeated = {"repeat": move["repeat"]} if "repeat" in move else {}
    return {"rest": Quantity.of(lasts, _SECONDS).text, **repeated, **of_others}
