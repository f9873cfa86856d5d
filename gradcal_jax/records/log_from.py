"""A log from arrays in memory, or from the columns of a DataFrame or an xarray Dataset, with units."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import numpy as np

from gradcal_jax import units as of_units
from gradcal_jax.records.log import Floats, Log, LogError
from gradcal_jax.records.log_faults import Columns, Policy, examine
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
    data: Any = None,
    units: Mapping[str, str] | None = None,
    sensor: str = "sensor",
    simulated: bool = False,
) -> Log:
    """A log from arrays, examined as a recording is: gaps, stamps that repeat, saturated rows, wrong units.

    `time` `(n,)` in s (or `datetime64`); `rate` `(n,)` of one axis, `(n, 3)` of x, y, z, or a mapping of axes to
    `(n,)`, in rad/s; `temperature` `(n,)` in °C; `angle`, of the table, `(n,)` or a mapping of table axes to `(n,)`, in
    rad, not wrapped; `force` as `rate`, in m/s², +1 g along an axis that points up; `standstill` `(n,)`: truth values,
    or numbers that are negative while the table moves; `host_time` `(n,)`: the computer's time of each row, in s.

    `data`: a DataFrame, a Dataset or a mapping; the other arguments are then names of its columns, lists of names, or
    mappings to names. `units`: of the arguments that are not in SI, such as {"rate": "deg/s", "angle": "deg"}; columns
    with `attrs["units"]` need none. `sensor`: name or serial number.

    Errors: `LogError` for columns that are not there or do not fit, and for faults of the data that need an answer.

    >>> import numpy as np
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal((6000, 3))
    >>> log = log_from(np.arange(6000) / 100.0, noise, units={"rate": "deg/s"}, simulated=True)
    >>> log.axes, round(1.0 / log.sample_interval_s), log.counts()
    (('x', 'y', 'z'), 100, {'used': 6000})
    """
    given = dict(units or {})
    if unknown := [key for key in given if key not in _KINDS]:
        raise LogError(f"units: {unknown[0]!r}: {instead(unknown[0], _KINDS)}")

    def named(kind: str, value: Any, labels: Sequence[str]) -> dict[str, Floats]:
        """The channels of an argument, by axis."""
        if isinstance(value, str):
            value = {labels[0]: value}
        if not isinstance(value, Mapping):
            if data is not None and not hasattr(value, "shape"):
                value = dict(zip(labels, value, strict=False))
            else:
                array = np.asarray(value, np.float64)
                if array.ndim not in (1, 2) or (array.ndim == 2 and array.shape[1] > len(labels)):
                    raise LogError(
                        f"{kind} has the shape {array.shape}; expected (n,) or (n, {len(labels)}), or a mapping of "
                        "axes to arrays"
                    )
                columns = array[:, None] if array.ndim == 1 else array
                value = dict(zip(labels, columns.T, strict=False))
        return {str(axis): _in_si(kind, one, data, given) for axis, one in cast("Mapping[Any, Any]", value).items()}

    rates = named("rate", rate, ("x", "y", "z"))
    if not rates:
        raise LogError("rate has no axis: give at least one")
    angles = {} if angle is None else named("angle", angle, tuple(rates))
    forces = {} if force is None else named("force", force, ("x", "y", "z"))
    stamps = _in_si("time", time, data, given)
    asked = {"temperature": temperature, "host_time": host_time}
    whole = {name: _in_si(name, value, data, given) for name, value in asked.items() if value is not None}
    if standstill is not None:
        whole["standstill"] = np.asarray(_column(standstill, data), np.float64)
    for name, values in (*rates.items(), *angles.items(), *forces.items(), *whole.items()):
        if values.shape != stamps.shape:
            raise LogError(f"{name} has the shape {values.shape}, and the times have the shape {stamps.shape}")
    return examine(
        Columns(
            rate_rad_per_s=np.stack(list(rates.values()), axis=-1)[None],
            units=(sensor,),
            axes=tuple(rates),
            time_s=stamps,
            specific_force_m_per_s2=np.stack(list(forces.values()), axis=-1)[None] if forces else None,
            force_axes=tuple(forces),
            temperature_c=whole["temperature"][None] if "temperature" in whole else None,
            table_axes=tuple(angles),
            table_angle_rad=np.stack(list(angles.values()), axis=-1) if angles else None,
            standstill=whole.get("standstill"),
            host_time_s=whole.get("host_time"),
            simulated=simulated,
            provenance={"source": "arrays"},
        ),
        Policy(),
    )


def _column(value: Any, data: Any) -> Any:
    """An array, or the column of this name."""
    if not isinstance(value, str):
        return value
    if data is None:
        raise LogError(f"{value!r} is the name of a column: also give data, the table that has this column")
    try:
        return data[value]
    except KeyError:
        there = [str(name) for name in data]
        raise LogError(f"there is no column {value!r}; {instead(value, there)}") from None


def _in_si(kind: str, value: Any, data: Any, given: Mapping[str, str]) -> Floats:
    column = _column(value, data)
    dimension, si = _KINDS[kind]
    unit = given.get(kind) or getattr(column, "attrs", {}).get("units") or si
    values = np.asarray(column)
    if values.dtype.kind in "mM":
        return (values - values[0] if values.dtype.kind == "M" else values) / np.timedelta64(1, "s")
    values = values.astype(np.float64)
    if kind == "time" and len(values):
        # The nanoseconds of an epoch.
        values = values - values[0] if abs(float(values[0])) > 1e9 else values
    at_zero = of_units.parse(f"0 {unit}", dimension)
    return values * (of_units.parse(f"1 {unit}", dimension) - at_zero) + at_zero
