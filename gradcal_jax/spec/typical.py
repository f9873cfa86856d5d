"""Typical figures of error terms by class of sensor and table, and a spec with those of the classes that it states.

The figures and their sources are data, `typical.toml`. With `[sensor] grade` (or `[rig.table] grade`), a term that the
file does not name has the figure of this class, as if the file stated it; the file itself stays short.
"""

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar, cast

from gradcal_jax.spec.bench import Rig, RigTable, TableAxis
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.sensor import Sensor
from gradcal_jax.tables.section import Section

if TYPE_CHECKING:
    from gradcal_jax.spec.spec_sections import Spec

Part = TypeVar("Part", bound=Section)
EARTH: Final = "rig.site.latitude"
_ANGLE: Final = "angle."


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


def grades() -> tuple[str, ...]:
    """Names of the classes of gyros."""
    return tuple(row["grade"] for row in class_table()["sensor"])


def terms_of(kind: str, grade: str) -> list[TypicalTerm]:
    """Every term of a class's typical error budget, its key within `kind`: "sensor", "accelerometer" or "table"."""
    return [TypicalTerm(term["key"], term["value"], term["source"]) for term in class_row(kind, grade)["term"]]


def typical_g_sensitivity(grade: str) -> str:
    """A typical sensitivity of a class's gyros to acceleration, 1σ."""
    return class_row("sensor", grade)["g_sensitivity"]["value"]


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


def class_row(kind: str, grade: str) -> dict[str, Any]:
    """The data of one class."""
    return next(row for row in class_table()[kind] if row["grade"] == grade)


def of_classes(spec: "Spec") -> tuple[Sensor, Rig]:
    """Sensor and rig of a spec, with the figures of the classes that it states for terms that it does not name.

    A key so filled is not among the keys that were set, and is not written into a file.
    """
    sensor, rig = spec.sensor, spec.rig
    if sensor.grade is not None:
        sensor = _sensor(sensor, sensor.grade)
    if rig.table.grade is not None:
        figures = {term.key: term.value for term in terms_of("table", rig.table.grade)}
        table = _table(spec, figures)
        site = rig.site
        if sensor.accelerometer is not None and site.gravity is not None:
            site = _filled(site, _some(figures, "gravity_accuracy"))
        if spec.is_one_axis:
            site = _filled(site, {"latitude": "unknown"})
        rig = _replaced(rig, table=table, site=site)
    return sensor, rig


def _sensor(sensor: Sensor, grade: str) -> Sensor:
    figures = {term.key: term.value for term in terms_of("sensor", grade)}
    gyro, force = sensor.gyro, sensor.accelerometer
    sensor = _filled(sensor, {key: value for key, value in figures.items() if key in Sensor.model_fields})
    if gyro is not None:
        # A temperature error acts through the slopes of the estimated maps.
        fixed = {f"{name}_slope" for name in ("bias", "scale_factor") if getattr(gyro, name) is None}
        error = figures["temperature_error"]
        figures["temperature_error"] = {key: value for key, value in error.items() if key not in fixed}
        gyro = _filled(gyro, {key: value for key, value in figures.items() if key not in Sensor.model_fields})
    if force is not None:
        force = _filled(force, {term.key: term.value for term in terms_of("accelerometer", grade)})
    return _replaced(sensor, gyro=gyro, accelerometer=force)


def _table(spec: "Spec", figures: Mapping[str, Any]) -> RigTable:
    table, alone = spec.rig.table, spec.is_one_axis
    keys = [] if alone else ["tilt", "azimuth"]
    if isinstance(spec.plan, StandardPlan):
        keys.append("rate_accuracy")
    axes = tuple(
        _axis(axis, figures, inner=k == len(table.axis) - 1, alone=alone, by_gravity=table.by_gravity)
        for k, axis in enumerate(table.axis)
    )
    mounting = table.mounting
    if alone:
        mounting = tuple(_filled(one, {"accuracy": figures["mounting_accuracy"]}) for one in mounting)
    return _replaced(_filled(table, _some(figures, *keys)), axis=axes, mounting=mounting)


def _axis(axis: TableAxis, figures: Mapping[str, Any], *, inner: bool, alone: bool, by_gravity: bool) -> TableAxis:
    of_angle = {key.removeprefix(_ANGLE): value for key, value in figures.items() if key.startswith(_ANGLE)}
    if not alone:
        del of_angle["backlash"]
    angle = axis.angle if by_gravity else _filled(axis.angle, of_angle)
    return _replaced(axis if inner else _filled(axis, _some(figures, "orthogonality")), angle=angle)


def _some(figures: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: figures[key] for key in keys}


def _filled(section: Part, figures: Mapping[str, Any]) -> Part:
    """The table with figures for keys that the file does not name."""
    stated = section.model_fields_set
    missing = {key: value for key, value in figures.items() if key not in stated}
    if not missing:
        return section
    whole = type(section).model_validate(section.model_dump(mode="json", exclude_unset=True) | missing)
    return _replaced(section, **{key: getattr(whole, key) for key in missing})


def _replaced(section: Part, **values: Any) -> Part:
    """The table with other values, which do not count as keys of the file."""
    copy = section.model_copy()
    vars(copy).update(values)
    return copy
