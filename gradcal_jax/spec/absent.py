"""Error terms that a spec does not name, each with its class's typical value.

With a stated `grade` this value counts as if the file named it (see `typical`); without one it counts in verdicts. A
term that the file names, even with zero or an empty list, is not absent. Only terms with an effect on the spec's own
plan are listed.
"""

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, Final

from gradcal_jax import units
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import HOST_CLOCK, Sensor
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.typical import (
    EARTH,
    Grade,
    TypicalTerm,
    class_row,
    class_table,
    grades,
    terms_of,
    typical_g_sensitivity,
)
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.section import Section

# Terms that act through one of the maps alone, or through motion or temperature.
_OF_BIAS: Final = frozenset({"turn_on_bias", "bias_temperature_gradient"})
_OF_SCALE_FACTOR: Final = frozenset({"sample_clock_error", "scale_factor_instability"})
_OF_RAMPS: Final = frozenset({"thermal_lag", "bias_temperature_gradient", "temperature_lag"})
# Terms of the table itself: of one axis the first, of any other IMU the others.
_OF_TABLE: Final = frozenset({"rate_accuracy", "tilt", "azimuth"})
EARTH_IS_UNKNOWN: Final = (
    "the Earth's rate along the axis is not stated, so the bias includes up to 15.04 deg/h of this rate: give "
    "[rig.site] latitude"
)


# Of normal gravity at sea level: 3.09 um/s^2 a metre of height, and 0.3 mm/s^2 of anomaly.
_NORMAL_GRAVITY: Final = TypicalTerm(
    "gravity_accuracy",
    "250 ug",
    "gravity is not stated; this figure is the error of normal gravity at sea level, for heights of up to 1000 m",
)


# Where rotation adds to the specific force that a gyro is sensitive to.
BESIDE_ACCELEROMETERS: Final = TypicalTerm(
    "g_sensitivity.lever_arm", "3 mm", "estimate, for gyros beside the accelerometers on one board"
)
_OFF_THE_AXES: Final = TypicalTerm(
    "g_sensitivity.lever_arm",
    "3 cm",
    "estimate, for a sensor on a table, without accelerometers that could measure the lever arm",
)

# By how much rotation may raise χ² of a gyro that has some thousands of readings.
_NOTICED: Final = 10.0


def absent_lever_arm(spec: Spec) -> TypicalTerm | None:
    """The lever arm of gyros that are sensitive to acceleration, its key in the spec, where the spec leaves it out and
    tests of the fit would notice it."""
    gyro = spec.sensor.gyro
    if gyro is None or gyro.g_sensitivity is None or gyro.g_sensitivity.prior is None:
        return None
    if "lever_arm" in gyro.g_sensitivity.model_fields_set:
        return None
    term = _OFF_THE_AXES if spec.sensor.accelerometer is None else BESIDE_ACCELEROMETERS
    arm = Quantity.of(units.parse(term.value, "length"), "m")
    felt = gyro.g_sensitivity.model_copy(update={"lever_arm": arm}).of_rotation
    more = felt**2 * _fourth_power_of_rates(spec) / float(gyro.angle_random_walk) ** 2
    return term._replace(key=f"sensor.gyro.{term.key}") if more > _NOTICED else None


def _fourth_power_of_rates(spec: Spec) -> float:
    """The integral of the fourth power of the plan's rates over time, (rad/s)⁴s, with the mean rate of each turn."""
    if isinstance(schedule := spec.schedule, StandardSchedule):
        return len(schedule.temperatures) * schedule.integration * sum(rate**4 for rate in schedule.rates)
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    turns = [s.move for s in schedule.every_step if not s.move.is_rest and s.move.duration]
    return cycles * sum(abs(move.angle) ** 4 / move.duration**3 for move in turns)


# Terms that a stated class does not supply.
_NEVER_OF_CLASS: Final = ("lever_arm", "hysteresis")


def absent_terms(spec: Spec) -> list[TypicalTerm]:
    """Every term of the error budget that affects the plan, and that neither the file nor its class states."""
    return [term for term in _unstated(spec) if not _is_of_class(spec, term.key)]


def class_terms(spec: Spec) -> list[TypicalTerm]:
    """Every term that affects the plan, and that has the figure of the class that the file states."""
    return [term for term in _unstated(spec) if _is_of_class(spec, term.key)]


def _is_of_class(spec: Spec, key: str) -> bool:
    grade = spec.sensor.grade if key.startswith("sensor.") else spec.rig.table.grade
    return grade is not None and not key.endswith(_NEVER_OF_CLASS)


def _unstated(spec: Spec) -> Iterator[TypicalTerm]:
    sensor, table, site, alone = spec.sensor, spec.rig.table, spec.rig.site, spec.is_one_axis
    gyro, force, keys = sensor.gyro, sensor.accelerometer, _keys_of_axis(spec) if alone else _keys_of_imu(spec)
    terms = [t for t in terms_of("sensor", sensor_grade(sensor).name) if t.key in keys]
    every = terms_of("table", table_grade(spec).name)
    of_table = [t for t in every if t.key in keys]
    common = set(type(sensor).model_fields)
    yield from _unnamed(sensor, "sensor", [_of_clock(t, sensor) for t in terms if t.key in common])
    if gyro is not None:
        # A temperature error acts through the slopes of the estimated maps.
        fixed = {f"{name}_slope" for name in ("bias", "scale_factor") if getattr(gyro, name) is None}
        for term in _unnamed(gyro, "sensor.gyro", [t for t in terms if t.key not in common]):
            if term.key.endswith("temperature_error"):
                yield term._replace(value={key: value for key, value in term.value.items() if key not in fixed})
            else:
                # Beside other channels a sensitivity to dT/dt is a figure, and no parameter.
                figure = not alone and term.key.endswith("gradient")
                yield term._replace(value=term.value["prior"]) if figure else term
        if (arm := absent_lever_arm(spec)) is not None:
            yield arm
    if force is not None:
        of_force = terms_of("accelerometer", accelerometer_grade(sensor).name)
        yield from _unnamed(force, "sensor.accelerometer", of_force)
        of_site = [t for t in every if t.key == "gravity_accuracy"]
        yield from _unnamed(site, "rig.site", of_site if site.gravity is not None else [_NORMAL_GRAVITY])
    # Hysteresis of quantities that are required on a branch of the temperature.
    branched = {_OF_BRANCHES[r.quantity] for r in spec.requirement if getattr(r, "branch", None) is not None}
    for kind in ("gyro", "accelerometer"):
        if (section := getattr(sensor, kind)) is not None:
            of_path = [t for t in path_terms_of(sensor, kind) if (kind, t.key) in branched]
            yield from _unnamed(section, f"sensor.{kind}", of_path)
    for term in [t for t in of_table if t.key == "mounting_accuracy"]:
        if "mounting" not in table.model_fields_set:
            yield term._replace(key="rig.table.mounting", value=[{"accuracy": term.value}])
        else:
            yield from _unnamed(table.mounting[0], "rig.table.mounting[0]", [term._replace(key="accuracy")])
    yield from _unnamed(table, "rig.table", [t for t in of_table if t.key in _OF_TABLE])
    for k, axis in enumerate(table.axis):
        if k < len(table.axis) - 1:
            yield from _unnamed(axis, f"rig.table.axis[{k}]", [t for t in every if t.key == "orthogonality"])
        if alone or not table.by_gravity:
            of_angle = [t._replace(key=t.key[6:]) for t in of_table if t.key.startswith("angle.")]
            yield from _unnamed(axis.angle, f"rig.table.axis[{k}].angle", of_angle)
    if alone and "latitude" not in site.model_fields_set:
        reason = "the Earth turns at 15.04 deg/h, and the angle between its axis and the table's is not stated"
        yield TypicalTerm(EARTH, "unknown", reason)


_OF_BRANCHES: Final = {
    "gyro_bias": ("gyro", "hysteresis"),
    "gyro_scale_factor": ("gyro", "scale_factor_hysteresis"),
    "accelerometer_bias": ("accelerometer", "hysteresis"),
    "accelerometer_scale_factor": ("accelerometer", "scale_factor_hysteresis"),
}
"""For each quantity whose requirement may state a `branch` (heating or cooling): the kind of its channel, and the key
of its hysteresis terms."""


def path_terms_of(sensor: Sensor, kind: str) -> list[TypicalTerm]:
    """What depends on the path of temperature in channels of the kind's class, its key within the triad's table."""
    grade = sensor_grade(sensor) if kind == "gyro" else accelerometer_grade(sensor)
    row = class_row("sensor" if kind == "gyro" else "accelerometer", grade.name)
    return [TypicalTerm(term["key"], term["value"], term["source"]) for term in row["path"]]


def branch_sentences(spec: Spec) -> list[str]:
    """What requirements leave out that name no branch of the temperature, with the figures of the class."""
    left, widest = list[str](), 0.0
    for quantity, (kind, key) in _OF_BRANCHES.items():
        open_ones = [r for r in spec.requirement if r.quantity == quantity and getattr(r, "branch", None) is None]
        triad = getattr(spec.sensor, kind)
        if not open_ones or triad is None or key in triad.model_fields_set:
            continue
        play = next(t.value[0] for t in path_terms_of(spec.sensor, kind) if t.key == key)
        width = units.parse(play["width"], "temperature difference")
        size, per = play["prior"].split(" ")
        left.append(f"±{float(size) * width:.3g} {per.removesuffix('/K')} of the {quantity.replace('_', ' ')}")
        widest = max(widest, width)
    if not left:
        return []
    sentences = [
        f"the requirements do not distinguish heating and cooling, so a hysteresis (in this class {', '.join(left)}) "
        'is not counted: add branch = "both" (or "heating" or "cooling") to them'
    ]
    if _goes_one_way(spec):
        returns = f"change the temperature back by {2.0 * widest:g} K or more{minutes_of_change(spec, 2.0 * widest)}"
        sentences.append(
            "one-way ramp, so the plan cannot observe a hysteresis, nor tell a drift during the run from a dependence "
            f"on temperature: {returns}"
        )
    return sentences


def attitude_sentences(spec: Spec) -> list[str]:
    """What requirements on the bias of gyros leave out where the spec has no sensitivity to acceleration."""
    gyro = spec.sensor.gyro
    names = [r.name for r in spec.requirement if r.quantity == "gyro_bias"]
    if gyro is None or gyro.g_sensitivity is not None or not names:
        return []
    size = typical_g_sensitivity(sensor_grade(spec.sensor).name).removesuffix("/g")
    words = ", ".join(f"'{name}'" for name in names)
    return [
        f"{words}: the result holds for the attitudes of the calibration. In another attitude, g-sensitivity "
        f"changes the bias of a gyro of this class by ±{size} for each g; this error is not counted: add "
        "[sensor.gyro.g_sensitivity] to estimate it"
    ]


def _goes_one_way(spec: Spec) -> bool:
    """Whether the plan's temperature changes in one direction alone."""
    if isinstance(spec.plan, StandardPlan):
        return False
    ramps = [s.temperature_end - s.temperature_start for s in spec.gradient_schedule.segments if s.kind == "ramp"]
    return len({change > 0.0 for change in ramps}) == 1


def minutes_of_change(spec: Spec, change_k: float) -> str:
    """The time that the chamber needs for a change of temperature at the slower of its rates, in brackets."""
    rate = min(float(spec.rig.chamber.max_heating), float(spec.rig.chamber.max_cooling))
    return f" ({change_k / rate / 60.0:.3g} min at {rate * 60.0:.3g} K/min)" if math.isfinite(rate) and rate else ""


def _unnamed(section: Section, prefix: str, terms: list[TypicalTerm]) -> Iterator[TypicalTerm]:
    """The terms that a table of the file does not name, with their whole keys."""
    for term in terms:
        if term.key not in section.model_fields_set:
            yield term._replace(key=f"{prefix}.{term.key}")


def with_typical(spec: Spec) -> Spec:
    """The spec with every absent term at its typical value. Errors: `SpecError` where the two contradict each other."""
    typical = {term.key: term.value for term in absent_terms(spec)}
    # The typical scale error of gears is that of their backlash, too.
    ends = ".angle.scale_error"
    none = {key.replace(ends, ".angle.backlash"): "0 deg" for key in typical if key.endswith(ends)}
    return changed(spec, none | typical) if typical else spec


def sensor_grade(sensor: Sensor) -> Grade:
    """The class of a gyro: `sensor.grade`, or else by its drift, or else by its angle random walk; of a unit without
    gyros that of its accelerometers."""
    if (gyro := sensor.gyro) is None:
        return accelerometer_grade(sensor)
    if sensor.grade is not None:
        return _stated("sensor", sensor.grade, "sensor.grade")
    return _by_noise("sensor", gyro.drift, "angular rate", gyro.angle_random_walk)


def accelerometer_grade(sensor: Sensor) -> Grade:
    """The class of a unit's accelerometers: `sensor.grade`, or else by their drift, or else by their velocity random
    walk; without any that of its gyros."""
    if (force := sensor.accelerometer) is None:
        return sensor_grade(sensor)
    if sensor.grade is not None:
        return _stated("accelerometer", sensor.grade, "sensor.grade")
    return _by_noise("accelerometer", force.drift, "acceleration", force.velocity_random_walk)


def grade_of_noise(kind: str, random_walk: Quantity) -> Grade:
    """The class of gyros ("sensor") or of an "accelerometer" of which only the white noise is known."""
    return _by_noise(kind, (), "acceleration" if kind == "accelerometer" else "angular rate", random_walk)


def _stated(kind: str, grade: str, reason: str) -> Grade:
    return Grade(grade, str(class_row(kind, grade)["like"]), reason)


def _by_noise(kind: str, drift: Any, dimension: str, walk: Quantity) -> Grade:
    if size := max((float(d.standard_deviation) for d in drift), default=0.0):
        return _grade(kind, size, "drift", dimension, "its drift")
    return _grade(kind, float(walk), "walk", walk.dimension, f"its {walk.dimension}")


def slopes_of(sensor: Sensor, kind: str = "gyro") -> tuple[float, float]:
    """Typical slopes over temperature of a channel's bias (rad/s/K or m/s^2/K) and of its scale factor (1/K): the
    spec's own, where it states them, or those of the class."""
    if kind == "accelerometer":
        row = class_row("accelerometer", accelerometer_grade(sensor).name)
        return units.parse(row["bias_slope"], "acceleration"), units.parse(row["scale_factor_slope"], "scale factor")
    typical = next(t.value for t in terms_of("sensor", sensor_grade(sensor).name) if t.key == "temperature_error")
    bias = units.parse(typical["bias_slope"], "bias slope")
    scale = units.parse(typical["scale_factor_slope"], "scale factor slope")
    if sensor.gyro is not None and (own := sensor.gyro.temperature_error) is not None:
        bias = bias if own.bias_slope is None else abs(float(own.bias_slope))
        scale = scale if own.scale_factor_slope is None else abs(float(own.scale_factor_slope))
    return bias, scale


def table_grade(spec: Spec) -> Grade:
    """The class of a rate table, by its named angle errors; the worst class without any."""
    angles = [axis.angle for axis in spec.rig.table.axis]
    size = max(max(float(a.reading_noise), float(a.standstill_offset)) for a in angles)
    if (stated := spec.rig.table.grade) is not None:
        return _stated("table", stated, "rig.table.grade")
    if size == 0.0:
        return _grade("table", math.inf, "angle", "angle", "the worst class, because the spec names no angle error")
    return _grade("table", size, "angle", "angle", "its angle errors")


# A prediction asks for the class a dozen times, of the same few texts.
_parsed = cache(units.parse)


def _grade(kind: str, size: float, key: str, dimension: str, reason: str) -> Grade:
    """The first class, beginning with the worst, whose lower limit is at or below a size; the last limit is zero."""
    row = next(row for row in class_table()[kind] if size >= _parsed(row[key], dimension))
    return Grade(row["grade"], row["like"], reason)


def _keys_of_axis(spec: Spec) -> set[str]:
    """The terms that affect the plan of a gyro along the only axis of a table."""
    gyro, plan = spec.sensor.gyro, spec.plan
    assert gyro is not None
    without = set(_OF_BIAS) - {"turn_on_bias"} if gyro.bias is None else set[str]()
    without |= _OF_SCALE_FACTOR if gyro.scale_factor is None else set()
    without |= {"sample_clock_error"} if spec.sensor.clock == "host" else set()
    without |= _OF_RAMPS if isinstance(plan, StandardPlan) else set()
    keys = {term.key for term in terms_of("sensor", grades()[0])} - without
    mounting = set[str]() if gyro.scale_factor is None else {"mounting_accuracy"}
    if isinstance(plan, StandardPlan):
        return keys | ({"rate_accuracy", *mounting} if any(float(rate) for rate in plan.rates or ()) else set())
    moves = [step.move for step in spec.gradient_schedule.steps]
    if not moves:
        # A standing axis is read at one angle: only errors that change between readings have an effect.
        return keys | {"angle.reading_noise"}
    keys |= {"angle.reading_noise", "angle.standstill_offset", "angle.harmonics", *mounting}
    # A typical scale error is that of gears with their play, and where there is none, there is no gear.
    of_gears = spec.rig.table.axis[0].angle.scale_error
    keys |= {"angle.scale_error", *(("angle.backlash",) if of_gears else ())} if mounting else set()
    on_the_move = any(move.read_every is not None and not move.is_rest for move in moves)
    return keys | ({"angle.timing_error"} if on_the_move else set())


def _keys_of_imu(spec: Spec) -> set[str]:
    """The same of any other IMU, but for accelerometers."""
    gyro, force = spec.sensor.gyro, spec.sensor.accelerometer
    keys = {"temperature_offset", "temperature_lag", "drift", "rate_random_walk", "turn_on_bias"}
    keys |= {"bias_temperature_gradient", "tilt", "azimuth"}
    keys |= {t.key for t in terms_of("table", class_table()["table"][0]["grade"]) if t.key.startswith("angle.")}
    keys -= {"angle.timing_error", "angle.backlash"}
    if gyro is not None and gyro.scale_factor is not None:
        keys |= {"scale_factor_instability", "sample_clock_error"}
    else:
        keys -= {"angle.scale_error"}
        keys |= {"sample_clock_error"} if force is not None and force.velocity_increments else set()
    return keys - ({"sample_clock_error"} if spec.sensor.clock == "host" else set())


def _of_clock(term: TypicalTerm, sensor: Sensor) -> TypicalTerm:
    """The computer's clock counts, with which a run compares the sensor's, unless the spec takes the sensor's."""
    if term.key != "sample_clock_error" or sensor.clock == "sensor":
        return term
    return term._replace(
        value=f"{HOST_CLOCK * 1e6:g} ppm", source="the computer's clock, with which a run compares the sensor's clock"
    )
