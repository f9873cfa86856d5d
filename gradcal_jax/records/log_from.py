"""A log from arrays in memory, with units."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import numpy as np

from gradcal_jax import units as unit_of
from gradcal_jax.records.examination import Columns, examine
from gradcal_jax.records.importers import elapsed, to_si
from gradcal_jax.records.log import Floats, Log, LogError
from gradcal_jax.tables.problems import instead

_SI: Final = {
    "time": ("s", "time"),
    "rate": ("rad/s", "angular rate"),
    "temperature": ("degC", "temperature"),
    "angle": ("rad", "angle"),
    "force": ("m/s^2", "acceleration"),
    "host_time": ("s", "time"),
}
"""By argument its unit if none is stated, and its dimension."""


def log_from(
    time: Any,
    rate: Any,
    *,
    temperature: Any = None,
    angle: Any = None,
    force: Any = None,
    standstill: Any = None,
    host_time: Any = None,
    units: Mapping[str, str] | None = None,
    sensor: str = "sensor",
    simulated: bool = False,
) -> Log:
    """A log from arrays, examined as a recording is: gaps, stamps that repeat, saturated rows, wrong units.

    `time` `(n,)` in s (or `datetime64`), counted from the first; `rate` `(n,)` of one axis, `(n, 3)` of x, y, z, or
    a mapping of axes to `(n,)`, in rad/s; `temperature` `(n,)` in °C; `angle`, of the table, `(n,)` or a mapping of
    table axes to `(n,)`, in rad, not wrapped; `force` as `rate`, in m/s², +1 g along an axis that points up;
    `standstill` `(n,)`: truth values, or numbers that are negative while the table moves; `host_time` `(n,)`: the
    computer's time of each row, in s. Columns of a DataFrame or a Dataset are such arrays.

    `units`: of the arguments that are not in SI, such as {"rate": "deg/s", "angle": "deg"}. `sensor`: name or serial
    number.

    Errors: `LogError` for arrays that do not fit, and for faults of the data that need an answer.

    >>> import numpy as np
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal((6000, 3))
    >>> log = log_from(np.arange(6000) / 100.0, noise, units={"rate": "deg/s"}, simulated=True)
    >>> log.axes, round(1.0 / log.sample_interval_s), log.counts()
    (('x', 'y', 'z'), 100, {'used': 6000})
    """
    stated = units or {}
    for key in stated:
        if key not in _SI:
            raise LogError(f"units: {key!r}: {instead(key, _SI)}")
    count = np.asarray(time).shape
    if 0 in count:
        raise LogError("time has no values: the log would have no rows")
    if type(sensor) is not str or not sensor:
        raise LogError(f"sensor: {sensor!r} is no name")
    if type(simulated) is not bool:
        raise LogError(f"simulated: {simulated!r} is not True or False")

    def fitting(kind: str, value: Any) -> Any:
        array = np.asarray(value)
        if array.shape != count:
            raise LogError(f"{kind} has the shape {array.shape}, and the times have the shape {count}")
        if array.dtype.kind not in "biufmM":
            raise LogError(f"{kind} has no numbers")
        return array

    def in_si(kind: str, value: Any) -> Floats:
        array = fitting(kind, value)
        unit, dimension = _SI[kind]
        unit = stated.get(kind, unit)
        if array.dtype.kind in "mM":
            array, unit = array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64), "ns"
        try:
            return to_si(elapsed(array) if dimension == "time" else array, unit, dimension)
        except unit_of.UnitError as error:
            raise LogError(f"{kind}: {error}") from None

    rates = _by_axis("rate", rate, ("x", "y", "z"))
    if not rates:
        raise LogError("rate has no axis: give at least one")
    values = {f"gyro {axis}": in_si("rate", one) for axis, one in rates.items()}
    values |= {f"accelerometer {axis}": in_si("force", one) for axis, one in _by_axis("force", force, "xyz").items()}
    values |= {f"table angle {axis}": in_si("angle", one) for axis, one in _by_axis("angle", angle, [*rates]).items()}
    for kind, value in (("time", time), ("temperature", temperature), ("host_time", host_time)):
        if value is not None:
            values[kind.replace("_", " ")] = in_si(kind, value)
    if standstill is not None:
        values["standstill"] = fitting("standstill", standstill).astype(np.float64)
    return examine(Columns(sensor, values, simulated=simulated, provenance={"source": "arrays"}))


def _by_axis(kind: str, value: Any, labels: Sequence[str]) -> dict[str, Any]:
    if value is None or isinstance(value, Mapping):
        by_axis = {str(axis): one for axis, one in cast("Mapping[Any, Any]", value or {}).items()}
        if "" in by_axis:
            raise LogError(f"{kind} has an axis without a name")
        return by_axis
    array = np.asarray(value)
    if array.ndim not in (1, 2) or (array.ndim == 2 and array.shape[1] > len(labels)):
        raise LogError(
            f"{kind} has the shape {array.shape}; expected (n,) or (n, {len(labels)}), or a mapping of axes to arrays"
        )
    return dict(zip(labels, array.reshape(len(array), -1).T, strict=False))
