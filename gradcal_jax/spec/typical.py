"""Typical figures of error terms by class of sensor and table, and a spec with those of the classes that it states.

The figures and their sources are data, `typical.toml`. With `[sensor] grade` (or `[rig.table] grade`), a term that the
file does not name has the figure of this class, as if the file stated it; the file itself stays short.
"""

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar, cast

from gradcal_jax import units
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.sensor import Sensor
from gradcal_jax.tables.problems import Key, split_key
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.section import Section

if TYPE_CHECKING:
    from gradcal_jax.spec.spec_sections import Spec

Part = TypeVar("Part", bound=Section)
EARTH: Final = "rig.site.latitude"


class Grade(NamedTuple):
    """The class of a sensor or table: its name, a typical device, and the reason."""

    name: str
    like: str
    reason: str


class TypicalTerm(NamedTuple):
    """An error term: its dotted key in the spec, a typical value for TOML, and the source of that figure."""

    key: str
    value: Any
    source: str

    @property
    def typical(self) -> str:
        """The value in words: ``10 deg/h, 100 s``."""
        return "up to 15.04 deg/h" if self.key == EARTH else _words(self.value)


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"order {v}" if k == "order" else str(v) for k, v in cast("dict[str, Any]", value).items())
    if isinstance(value, list):
        return "; ".join(_words(entry) for entry in cast("list[Any]", value))
    return str(value)


@cache
def class_table() -> dict[str, Any]:
    """The data of `typical.toml`."""
    text = (resources.files("gradcal_jax.spec") / "typical.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def grades() -> tuple[str, ...]:
    """Names of the classes of gyros."""
    return tuple(row["grade"] for row in class_table()["sensor"])


def class_row(kind: str, grade: str) -> dict[str, Any]:
    """The data of one class of a kind: "sensor" (gyros), "accelerometer" or "table"."""
    return next(row for row in class_table()[kind] if row["grade"] == grade)


def terms_of(kind: str, grade: str, part: str = "term") -> list[TypicalTerm]:
    """Every term of a class's typical error budget, its key within `kind`; of the `part` "path", those that depend on
    the path of temperature."""
    return [TypicalTerm(**term) for term in class_row(kind, grade)[part]]


def other_term(name: str) -> TypicalTerm:
    """A term that does not depend on a class."""
    return TypicalTerm(**class_table()["other"][name])


# A prediction asks for the class a dozen times, of the same few texts.
@cache
def si_of(text: str) -> float:
    """The SI value of a figure of the data."""
    return units.parse(text, units.dimension_of(units.unit_of(text)))


def sensor_grade(sensor: Sensor, kind: str = "sensor") -> Grade:
    """The class of the gyros ("sensor") or of the accelerometers ("accelerometer"), or of those that there are:
    `sensor.grade`, or else by their drift, or else by their random walk."""
    if sensor.gyro is None:
        kind = "accelerometer"
    elif sensor.accelerometer is None:
        kind = "sensor"
    if sensor.grade is not None:
        return Grade(sensor.grade, class_row(kind, sensor.grade)["like"], "sensor.grade")
    triad: Any = sensor.gyro if kind == "sensor" else sensor.accelerometer
    if size := max((float(drift.standard_deviation) for drift in triad.drift), default=0.0):
        return _grade(kind, "drift", size, "its drift")
    return grade_of_noise(kind, triad.angle_random_walk if kind == "sensor" else triad.velocity_random_walk)


def grade_of_noise(kind: str, random_walk: Quantity) -> Grade:
    """The class of gyros ("sensor") or of an "accelerometer" of which only the white noise is known."""
    return _grade(kind, "walk", float(random_walk), f"its {random_walk.dimension}")


def table_grade(spec: "Spec") -> Grade:
    """The class of a rate table, by its named angle errors; the worst class without any."""
    if (stated := spec.rig.table.grade) is not None:
        return Grade(stated, class_row("table", stated)["like"], "rig.table.grade")
    angles = [axis.angle for axis in spec.rig.table.axis]
    size = max(max(float(a.reading_noise), float(a.standstill_offset)) for a in angles)
    if size == 0.0:
        return _grade("table", "angle", math.inf, "the worst class, because the spec names no angle error")
    return _grade("table", "angle", size, "its angle errors")


def _grade(kind: str, key: str, size: float, reason: str) -> Grade:
    """The first class, beginning with the worst, whose lower limit is at or below a size; the last limit is zero."""
    row = next(row for row in class_table()[kind] if size >= si_of(row[key]))
    return Grade(row["grade"], row["like"], reason)


def slopes_of(sensor: Sensor, kind: str = "gyro") -> tuple[float, float]:
    """Typical slopes over temperature of a channel's bias (rad/s/K or m/s^2/K) and of its scale factor (1/K): the
    spec's own, where it states them, or those of the class."""
    if kind == "accelerometer":
        row = class_row(kind, sensor_grade(sensor, kind).name)
        return si_of(row["bias_slope"]), si_of(row["scale_factor_slope"])
    terms = terms_of("sensor", sensor_grade(sensor).name)
    typical = next(term.value for term in terms if term.key == "temperature_error")
    own = None if sensor.gyro is None else sensor.gyro.temperature_error
    slopes: list[float] = []
    for key in ("bias_slope", "scale_factor_slope"):
        stated = getattr(own, key, None)
        slopes.append(si_of(typical[key]) if stated is None else abs(float(stated)))
    return slopes[0], slopes[1]


def is_of_class(spec: "Spec", key: str) -> bool:
    """Whether a term that the file does not name has the figure of a class that the file states."""
    return (spec.sensor.grade if key.startswith("sensor.") else spec.rig.table.grade) is not None


def unnamed_terms(spec: "Spec") -> Iterator[TypicalTerm]:
    """Every term of the classes that a file does not name, with its whole key, whatever the plan."""
    for prefix, section, terms in _tables(spec):
        for term in terms:
            if term.key not in section.model_fields_set:
                yield term._replace(key=f"{prefix}.{term.key}")


def _tables(spec: "Spec") -> Iterator[tuple[str, Section, list[TypicalTerm]]]:
    """The tables of a spec, each with its key, and the terms of the classes that belong into it."""
    sensor, table, site, alone = spec.sensor, spec.rig.table, spec.rig.site, spec.is_one_axis
    of_sensor = terms_of("sensor", sensor_grade(sensor).name)
    of_table = {term.key: term for term in terms_of("table", table_grade(spec).name)}
    yield "sensor", sensor, [term for term in of_sensor if term.key in Sensor.model_fields]
    if (gyro := sensor.gyro) is not None:
        of_gyro = [term for term in of_sensor if term.key not in Sensor.model_fields]
        # A temperature error acts through the slopes of the estimated maps.
        fixed = {f"{name}_slope" for name in ("bias", "scale_factor") if getattr(gyro, name) is None}
        for k, term in enumerate(of_gyro):
            if term.key == "temperature_error":
                value = {key: value for key, value in term.value.items() if key not in fixed}
                of_gyro[k] = term._replace(value=value)
        yield "sensor.gyro", gyro, of_gyro
    if (force := sensor.accelerometer) is not None:
        grade = sensor_grade(sensor, "accelerometer").name
        yield "sensor.accelerometer", force, terms_of("accelerometer", grade)
        gravity = of_table["gravity_accuracy"] if site.gravity else other_term("gravity_accuracy")
        yield "rig.site", site, [gravity]
    if isinstance(spec.plan, StandardPlan):
        yield "rig.table", table, [of_table["rate_accuracy"]]
    if alone:
        accuracy = of_table["mounting_accuracy"]._replace(key="accuracy")
        yield "rig.table.mounting[0]", table.mounting[0], [accuracy]
        yield "rig.site", site, [other_term("latitude")]
    else:
        yield "rig.table", table, [of_table["tilt"], of_table["azimuth"]]
    angle = [t._replace(key=key.removeprefix("angle.")) for key, t in of_table.items() if key.startswith("angle.")]
    for k, axis in enumerate(table.axis):
        if k < len(table.axis) - 1:
            yield f"rig.table.axis[{k}]", axis, [of_table["orthogonality"]]
        if not table.by_gravity:
            of_axis = [term for term in angle if alone or term.key != "backlash"]
            yield f"rig.table.axis[{k}].angle", axis.angle, of_axis


def with_classes(spec: "Spec") -> "Spec":
    """The spec with the figures of the classes that it states for terms that it does not name. A key so filled is not
    among the keys that were set, and is not written into a file."""
    if spec.sensor.grade is None and spec.rig.table.grade is None:
        return spec
    return filled(spec, [term for term in unnamed_terms(spec) if is_of_class(spec, term.key)], named=False)


def filled(part: Part, terms: Iterable[TypicalTerm], *, named: bool) -> Part:
    """A spec with terms that it does not name; `named`: as if the file named them. Errors: `SpecError`."""
    figures: dict[Key, dict[str, Any]] = {}
    for term in terms:
        *table, last = split_key(term.key)
        figures.setdefault(tuple(table), {})[str(last)] = term.value
    for table, values in figures.items():
        part = _put(part, table, values, named)
    return part


def _put(part: Section | tuple[Section, ...], key: Key, values: dict[str, Any], named: bool) -> Any:
    """A table, or a list of tables, with values in the table at `key` below it."""
    if isinstance(part, tuple):
        return tuple(_put(one, key[1:], values, named) if k == key[0] else one for k, one in enumerate(part))
    if key:
        name = str(key[0])
        changes = {name: _put(getattr(part, name), key[1:], values, named)}
    else:
        whole = type(part).model_validate(part.model_dump(mode="json", exclude_unset=True) | values)
        changes = {name: getattr(whole, name) for name in values}
    if named:
        return part.model_copy(update=changes)
    copy = part.model_copy()
    vars(copy).update(changes)
    return copy
