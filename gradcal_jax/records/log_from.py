"""A log from arrays in memory, with units."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import numpy as np

from gradcal_jax import units as of_units
from gradcal_jax.records.log import Floats, Log, LogError
from gradcal_jax.records.log_faults import Columns, examine
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
    stamps = _in_si("time", time, stated)

    def one(kind: str, value: Any) -> Floats | None:
        if value is None:
            return None
        values = np.asarray(value, np.float64) if kind == "standstill" else _in_si(kind, value, stated)
        if values.shape != stamps.shape:
            raise LogError(f"{kind} has the shape {values.shape}, and the times have the shape {stamps.shape}")
        return values

    def channels(kind: str, value: Any, labels: Sequence[str]) -> dict[str, Floats]:
        """By axis."""
        if value is None:
            return {}
        if not isinstance(value, Mapping):
            array = np.asarray(value, np.float64)
            if array.ndim not in (1, 2) or (array.ndim == 2 and array.shape[1] > len(labels)):
                raise LogError(
                    f"{kind} has the shape {array.shape}; expected (n,) or (n, {len(labels)}), or a mapping of axes to "
                    "arrays"
                )
            columns = array[:, None] if array.ndim == 1 else array
            value = dict(zip(labels, columns.T, strict=False))
        of_axes = {str(axis): one(kind, values) for axis, values in cast("Mapping[Any, Any]", value).items()}
        return cast("dict[str, Floats]", of_axes)

    rates = channels("rate", rate, ("x", "y", "z"))
    if not rates:
        raise LogError("rate has no axis: give at least one")
    angles = channels("angle", angle, tuple(rates))
    forces = channels("force", force, ("x", "y", "z"))
    warm = one("temperature", temperature)
    return examine(
        Columns(
            rate_rad_per_s=np.stack(list(rates.values()), axis=-1)[None],
            units=(sensor,),
            axes=tuple(rates),
            time_s=stamps,
            specific_force_m_per_s2=np.stack(list(forces.values()), axis=-1)[None] if forces else None,
            force_axes=tuple(forces),
            temperature_c=None if warm is None else warm[None],
            table_axes=tuple(angles),
            table_angle_rad=np.stack(list(angles.values()), axis=-1) if angles else None,
            standstill=one("standstill", standstill),
            host_time_s=one("host_time", host_time),
            simulated=simulated,
            provenance={"source": "arrays"},
        )
    )


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
