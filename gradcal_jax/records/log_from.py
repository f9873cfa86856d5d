"""A log from arrays in memory, with units."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import numpy as np

from gradcal_jax import units as of_units
from gradcal_jax.records.examination import Columns, examine
from gradcal_jax.records.log import Floats, Log, LogError
from gradcal_jax.tables.problems import instead

# By argument its dimension and its unit in SI.
_KINDS: Final = {
    "time": ("time", "s"),
    "rate": ("angular rate", "rad/s"),
    "temperature": ("temperature", "degC"),
    "angle": ("angle", "rad"),
    "force": ("acceleration", "m/s^2"),
    "host_time": ("time", "s"),
}


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

    `time` `(n,)` in s (or `datetime64`); `rate` `(n,)` of one axis, `(n, 3)` of x, y, z, or a mapping of axes to
    `(n,)`, in rad/s; `temperature` `(n,)` in °C; `angle`, of the table, `(n,)` or a mapping of table axes to `(n,)`, in
    rad, not wrapped; `force` as `rate`, in m/s², +1 g along an axis that points up; `standstill` `(n,)`: truth values,
    or numbers that are negative while the table moves; `host_time` `(n,)`: the computer's time of each row, in s.
    Columns of a DataFrame or a Dataset are such arrays.

    `units`: of the arguments that are not in SI, such as {"rate": "deg/s", "angle": "deg"}. `sensor`: name or serial
    number.

    Errors: `LogError` for arrays that do not fit, and for faults of the data that need an answer.

    >>> import numpy as np
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal((6000, 3))
    >>> log = log_from(np.arange(6000) / 100.0, noise, units={"rate": "deg/s"}, simulated=True)
    >>> log.axes, round(1.0 / log.sample_interval_s), log.counts()
    (('x', 'y', 'z'), 100, {'used': 6000})
    """
    stated = dict(units or {})
    if unknown := [key for key in stated if key not in _KINDS]:
        raise LogError(f"units: {unknown[0]!r}: {instead(unknown[0], _KINDS)}")
    values = {"time": _in_si("time", time, stated)}
    rates = _by_axis("rate", rate, ("x", "y", "z"))
    if not rates:
        raise LogError("rate has no axis: give at least one")
    channels = {f"gyro {axis}": ("rate", one) for axis, one in rates.items()}
    channels |= {f"accelerometer {axis}": ("force", one) for axis, one in _by_axis("force", force, "xyz").items()}
    channels |= {f"table angle {axis}": ("angle", one) for axis, one in _by_axis("angle", angle, tuple(rates)).items()}
    channels |= {"temperature": ("temperature", temperature), "standstill": ("standstill", standstill)}
    channels["host time"] = "host_time", host_time
    for name, (kind, array) in channels.items():
        if array is None:
            continue
        one = np.asarray(array, np.float64) if kind == "standstill" else _in_si(kind, array, stated)
        if one.shape != values["time"].shape:
            raise LogError(f"{kind} has the shape {one.shape}, and the times have the shape {values['time'].shape}")
        values[name] = one[None] if name.startswith(("gyro", "accelerometer", "temperature")) else one
    return examine(Columns((sensor,), values, simulated=simulated, provenance={"source": "arrays"}))


def _by_axis(kind: str, value: Any, labels: Sequence[str]) -> dict[str, Any]:
    if value is None or isinstance(value, Mapping):
        return {str(axis): one for axis, one in cast("Mapping[Any, Any]", value or {}).items()}
    array = np.asarray(value, np.float64)
    if array.ndim not in (1, 2) or (array.ndim == 2 and array.shape[1] > len(labels)):
        raise LogError(
            f"{kind} has the shape {array.shape}; expected (n,) or (n, {len(labels)}), or a mapping of axes to arrays"
        )
    return dict(zip(labels, array.reshape(len(array), -1).T, strict=False))


def _in_si(kind: str, value: Any, stated: Mapping[str, str]) -> Floats:
    dimension, si = _KINDS[kind]
    values = np.asarray(value)
    if values.dtype.kind in "mM":
        return (values - values[0] if values.dtype.kind == "M" else values) / np.timedelta64(1, "s")
    values = values.astype(np.float64)
    if kind == "time" and len(values):
        # The nanoseconds of an epoch.
        values = values - values[0] if abs(float(values[0])) > 1e9 else values
    unit = stated.get(kind, si)
    at_zero = of_units.parse(f"0 {unit}", dimension)
    return values * (of_units.parse(f"1 {unit}", dimension) - at_zero) + at_zero
