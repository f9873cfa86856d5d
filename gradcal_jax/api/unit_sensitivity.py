"""Elasticities of a unit's residuals in every figure of sensor, rig and plan, by central differences.

The figures are changed in the spec itself, by a thousandth up and down. Faster turns may change the number of cycles in
the ramp; such a side is left out, and where both are, the figure has no row. Where all times become longer, the number
of readings stays, since an integer has no derivative.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from gradcal_jax.api.unit_build import assemble_unit
from gradcal_jax.api.unit_prediction import posterior_of_unit
from gradcal_jax.api.unit_residual import UNIT_OF_QUANTITY, decisive_value
from gradcal_jax.files.changes import changed, tables_of
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.units import dimension_of, format_quantity, parse, unit_of

_STEP = 1e-3
TIME = "time: ramp, rests and turns last longer"
RATES = "rates: all turns faster"
# Patterns of keys, and the name of their figure for people.
_FIGURES: tuple[tuple[str, str], ...] = (
    (r"sensor\.(gyro|accelerometer)\.(angle|velocity|rate)_random_walk", "{0}: {1} random walk"),
    (r"sensor\.(gyro|accelerometer)\.drift\[\d+\]\.standard_deviation", "{0}: drift"),
    (r"sensor\.(gyro|accelerometer)\.drift\[\d+\]\.correlation_time", "{0}: drift's correlation time"),
    (r"sensor\.gyro\.scale_factor_instability\[\d+\]\.standard_deviation", "gyro: scale-factor instability"),
    (r"sensor\.gyro\.scale_factor_instability\[\d+\]\.correlation_time", "gyro: its correlation time"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.prior", "{0}: prior of {1}"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.discrepancy\.standard_deviation", "{0}: discrepancy of {1}"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.smoothness", "{0}: smoothness of {1}"),
    (r"sensor\.(thermal_lag|sample_clock_error)", "{0}"),
    (r"rig\.site\.gravity_accuracy", "accuracy of gravity"),
    (r"rig\.table\.(tilt|azimuth)", "{0} of the base"),
    (r"rig\.table\.axis\[\d+\]\.orthogonality", "angle between the table's axes"),
    (r"rig\.table\.axis\[\d+\]\.angle\.(reading_noise|standstill_offset)", "table: {0}"),
    (r"rig\.table\.axis\[\d+\]\.angle\.harmonics\[\d+\]\.amplitude", "table: encoder's error by angle"),
    (r"rig\.table\.mounting\[\d+\]\.accuracy", "accuracy of the mounting"),
)
# Powers of a common factor of time, by dimension.
_POWERS = {"time": 1, "angular rate": -1, "temperature slope": -1, "angular acceleration": -2}
_RIG = r"rig\.(table\.axis\[\d+\]\.max_(rate|acceleration)|chamber\.max_(heating|cooling))"
_PLAN = r"plan\.(gradient|soak\.duration|programme\[\d+\]\.(soak|rate))"
_MOVES = r"plan\.cycle\.moves\[\d+\]\.(rest|duration|peak_rate|period|ramp)"


class Elasticity(NamedTuple):
    """`percent`: the change of the requirement's residual, in per cent, for one per cent more of `figure`."""

    requirement: str
    figure: str
    percent: float


class Sensitivities(NamedTuple):
    """Elasticities, and the residual of each requirement in its unit."""

    rows: tuple[Elasticity, ...]
    residuals: dict[str, tuple[float, str]]


def unit_sensitivities(spec: UnitSpec) -> Sensitivities:
    """The elasticities of every requirement of a unit's spec. Errors: `ValueError` where nothing is required or
    observed."""
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there is nothing to be sensitive: add one")
    nominal = _residuals(spec)
    hidden = [r.name for r, value in zip(spec.requirement, nominal, strict=True) if not np.isfinite(value)]
    if hidden:
        names = ", ".join(hidden)
        raise ValueError(f"the plan cannot observe {names}, so its sensitivity is not defined: see gradcal check")
    rows: list[Elasticity] = []
    for figure, powers in sensitive_figures(spec).items():
        percent = _elasticity(spec, powers, nominal)
        if percent is not None:
            rows += [Elasticity(r.name, figure, float(p)) for r, p in zip(spec.requirement, percent, strict=True)]
    rows.sort(key=lambda row: (row.requirement, -abs(row.percent)))
    left = zip(spec.requirement, nominal, strict=True)
    residuals = {r.name: (float(value), UNIT_OF_QUANTITY[r.quantity][0]) for r, value in left}
    return Sensitivities(tuple(rows), residuals)


def sensitive_figures(spec: UnitSpec) -> dict[str, dict[str, int]]:
    """The figures of a spec by name, each with its keys and their powers of the factor."""
    figures: dict[str, dict[str, int]] = {}
    time = {f"rig.table.axis[{k}].angle.read_every": 1 for k in range(len(spec.rig.table.axis))}
    rates: dict[str, int] = {}
    for key, text in _texts(tables_of(spec), ""):
        for pattern, name in _FIGURES:
            if (match := re.fullmatch(pattern, key)) is not None and _number(text) != 0.0:
                words = (group.replace("_", " ") for group in match.groups())
                figures.setdefault(name.format(*words), {})[key] = 1
        if re.fullmatch(f"{_RIG}|{_PLAN}|{_MOVES}", key):
            time[key] = _POWERS[dimension_of(unit_of(text))]
            if not re.fullmatch(_PLAN, key) and not key.endswith(".rest") and "chamber" not in key:
                rates[key] = -time[key]
    moving = any(step.axis >= 0 for step in spec.schedule.steps)
    return figures | {TIME: time} | ({RATES: rates} if moving else {})


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for name, entry in cast("Mapping[str, Any]", value).items():
            yield from _texts(entry, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for k, entry in enumerate(cast("list[Any]", value)):
            yield from _texts(entry, f"{key}[{k}]")
    elif isinstance(value, str):
        yield key, value


def _number(text: str) -> float:
    return parse(text, dimension_of(unit_of(text)))


def _elasticity(spec: UnitSpec, powers: Mapping[str, int], nominal: np.ndarray) -> np.ndarray | None:
    """d ln(residuals)/d ln(figure), by a central difference where both sides have the plan's number of cycles."""
    texts, cycles = dict(_texts(tables_of(spec), "")), [stretch.cycles for stretch in spec.schedule.stretches]
    for k, axis in enumerate(spec.rig.table.axis):
        texts.setdefault(f"rig.table.axis[{k}].angle.read_every", str(axis.angle.read_every))
    logs: list[np.ndarray] = []
    places: list[float] = []
    for step in (-_STEP, _STEP):
        scaled = {
            key: format_quantity(_number(texts[key]) * (1.0 + step) ** power, unit_of(texts[key]))
            for key, power in powers.items()
        }
        other = changed(spec, scaled)
        if [stretch.cycles for stretch in other.schedule.stretches] == cycles:
            logs.append(np.log(_residuals(other)))
            places.append(np.log1p(step))
    if not logs:
        return None
    if len(logs) == 1:
        logs, places = [np.log(nominal), *logs], [0.0, *places]
    return (logs[1] - logs[0]) / (places[1] - places[0])


def _residuals(spec: UnitSpec) -> np.ndarray:
    """The value of every requirement's own statistic; infinite where it is not observable."""
    built = assemble_unit(spec)
    known = posterior_of_unit(built)
    values = [decisive_value(built, known, r) for r in spec.requirement]
    return np.array([np.inf if value is None else value for value in values])
