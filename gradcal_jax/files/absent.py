"""Error terms that a spec does not name and that its prediction counts as zero, each with its class's typical value.

The figures and their sources are data, `typical.toml`; a term that the file names, even with zero or an empty list, is
not absent. Only terms with an effect on the spec's own plan are listed.
"""

import math
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple, cast

from gradcal_jax import units
from gradcal_jax.files.changes import changed
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.sensor import Sensor
from gradcal_jax.files.spec import Spec

# Terms that act through one of the maps alone, or through motion or temperature.
_OF_BIAS: Final = frozenset({"turn_on_bias", "bias_temperature_gradient"})
_OF_SCALE_FACTOR: Final = frozenset({"sample_clock_error", "scale_factor_instability"})
_OF_RAMPS: Final = frozenset({"thermal_lag", "bias_temperature_gradient"})


class Grade(NamedTuple):
    """The class of a sensor or table: its name, a typical device, and the reason."""

    name: str
    like: str
    reason: str


class AbsentTerm(NamedTuple):
    """An absent term: its dotted key in the spec, a typical value for TOML, and the source of that figure."""

    key: str
    value: Any
    source: str

    @property
    def typical(self) -> str:
        """The value in words: ``10 deg/h, 100 s``."""
        return _words(self.value)


def absent_terms(spec: Spec) -> list[AbsentTerm]:
    """Every term of the error budget that the file does not name and that affects its plan. Errors: none."""
    sensor, table = spec.sensor, spec.rig.table
    named = {"sensor": sensor.model_fields_set, "rig.table": table.model_fields_set}
    named["rig.table"] = named["rig.table"] | {f"angle.{name}" for name in table.angle.model_fields_set}
    return [
        AbsentTerm(f"{prefix}.{term.key}", _of_the_maps(term, sensor), term.source)
        for prefix, terms, matters in (
            ("sensor", terms_of("sensor", sensor_grade(sensor).name), _matters_of_sensor(spec)),
            ("rig.table", terms_of("table", table_grade(spec).name), _matters_of_table(spec)),
        )
        for term in terms
        if term.key in matters and term.key not in named[prefix]
    ]


def with_typical(spec: Spec) -> Spec:
    """The spec with every absent term at its typical value. Errors: `SpecError` where the two contradict each other."""
    return changed(spec, {term.key: term.value for term in absent_terms(spec)})


def sensor_grade(sensor: Sensor) -> Grade:
    """The class of a gyro: `sensor.grade`, or else by its drift, or else by its angle random walk."""
    if sensor.grade is not None:
        return Grade(sensor.grade, str(_row("sensor", sensor.grade)["like"]), "sensor.grade")
    size = max((float(d.standard_deviation) for d in sensor.drift), default=0.0)
    key, dimension, shown = "drift", "angular rate", "its drift"
    if size == 0.0:
        size, key, dimension = float(sensor.angle_random_walk), "walk", "angle random walk"
        shown = "its angle random walk"
    return _grade("sensor", size, key, dimension, shown)


def table_grade(spec: Spec) -> Grade:
    """The class of a rate table, by its named angle errors; the worst class without any."""
    angle = spec.rig.table.angle
    size = max(float(angle.reading_noise), float(angle.standstill_offset))
    if size == 0.0:
        return _grade("table", math.inf, "angle", "angle", "the worst: no angle error is named")
    return _grade("table", size, "angle", "angle", "its angle errors")


def _grade(kind: str, size: float, key: str, dimension: str, reason: str) -> Grade:
    """The first class, beginning with the worst, whose lower limit is at or below a size; the last limit is zero."""
    row = next(row for row in _table()[kind] if size >= units.parse(row[key], dimension))
    return Grade(row["grade"], row["like"], reason)


def grades() -> tuple[str, ...]:
    """Names of the classes of gyros."""
    return tuple(row["grade"] for row in _table()["sensor"])


def terms_of(kind: str, grade: str) -> list[AbsentTerm]:
    """Every term of a class's typical error budget, its key within `kind`: "sensor" or "table"."""
    return [AbsentTerm(term["key"], term["value"], term["source"]) for term in _row(kind, grade)["term"]]


def _matters_of_sensor(spec: Spec) -> set[str]:
    sensor = spec.sensor
    left_out: set[str] = set()
    if sensor.bias is None:
        left_out |= _OF_BIAS - {"turn_on_bias"}
    if sensor.scale_factor is None:
        left_out |= _OF_SCALE_FACTOR
    if isinstance(spec.plan, StandardPlan):
        left_out |= _OF_RAMPS
    return {term.key for term in terms_of("sensor", grades()[0])} - left_out


def _matters_of_table(spec: Spec) -> set[str]:
    plan = spec.plan
    if isinstance(plan, StandardPlan):
        return {"rate_accuracy"} if any(float(rate) for rate in plan.rates or ()) else set()
    cycle = spec.gradient_schedule.cycle
    if cycle is None:
        # A standing axis is read at one angle: only errors that change between readings have an effect.
        return {"angle.reading_noise"}
    matters = {"angle.reading_noise", "angle.standstill_offset", "angle.harmonics"}
    on_the_move = any(move.read_every is not None and not move.is_rest for move in cycle.moves)
    return matters | ({"angle.timing_error"} if on_the_move else set())


def _of_the_maps(term: AbsentTerm, sensor: Sensor) -> Any:
    """A temperature error acts through the slopes of the estimated maps."""
    if term.key != "temperature_error":
        return term.value
    maps = {"bias_slope": sensor.bias, "scale_factor_slope": sensor.scale_factor}
    without = {name for name, section in maps.items() if section is None}
    return {name: value for name, value in term.value.items() if name not in without}


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"order {v}" if k == "order" else str(v) for k, v in cast("dict[str, Any]", value).items())
    if isinstance(value, list):
        return "; ".join(_words(entry) for entry in cast("list[Any]", value))
    return str(value)


@cache
def _table() -> dict[str, Any]:
    text = (resources.files(__package__ or "gradcal_jax.files") / "typical.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _row(kind: str, grade: str) -> dict[str, Any]:
    return next(row for row in _table()[kind] if row["grade"] == grade)
