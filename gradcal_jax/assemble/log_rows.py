"""One unit's rows of one axis, as a log has them, ready for integration."""

from typing import NamedTuple

import numpy as np

from gradcal_jax import estimation as room
from gradcal_jax.assemble.build import Assembled
from gradcal_jax.assemble.estimate_options import Options
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.identify import lagged


class Rows(NamedTuple):
    """One unit's rows of one axis, ready for integration."""

    time: np.ndarray
    step: np.ndarray
    rate: np.ndarray
    temperature: np.ndarray
    angle: np.ndarray | None
    table_rate: np.ndarray | None
    standing: np.ndarray
    usable: np.ndarray
    messages: tuple[str, ...]


def rows_of(built: Assembled, log: Log, axis: str, unit: int, options: Options) -> Rows:
    """What the log has of them; `messages` say what was done about what it has not. Raises `LogError`."""
    messages: list[str] = []
    time = log.time_s
    if options.clock == "host":
        time, said = _host_time(log)
        messages.append(said)
    usable = log.usable(unit).copy()
    usable[log.stretch_starts] = False  # what lay before the row was not recorded
    raw = log.rate_rad_per_s[unit, :, log.axis_index(axis)]
    rate = np.where(np.isfinite(raw), raw, 0.0)
    usable &= np.isfinite(raw)
    temperature = room.smoothed_temperature(time, _temperature(built, log, unit))
    table = table_axis_of(log, axis, options.table_axis)
    angle = None if table is None or log.table_angle_rad is None else log.table_angle_rad[:, table]
    table_rate = None if table is None or log.table_rate_rad_per_s is None else log.table_rate_rad_per_s[:, table]
    if log.standstill is not None:
        standing = log.standstill >= 0
    elif isinstance(built.spec.schedule, StandardSchedule):
        standing = np.zeros(len(time), bool)
    else:
        number = room.find_standstills(log.rate_rad_per_s[unit], log.sample_interval_s, valid=log.usable(unit))
        standing = number >= 0
        messages.append(f"the log marks no standstills: {int(number.max()) + 1} were found where the rates are quiet")
    if angle is not None:
        known = np.isfinite(angle)
        if standing.any() and not known[standing].any():
            raise LogError("the table's angle is missing wherever it stands: it is the reference")
        if not known[standing].all():
            count = int(np.count_nonzero(standing & ~known))
            messages.append(f"{count} rows of rest without a table angle are no reference, and are not read")
            standing = standing & known
        angle = angle if known.all() else np.interp(time, time[known], angle[known])
    return Rows(
        time,
        np.diff(time, prepend=time[0]),
        rate,
        temperature,
        angle,
        table_rate,
        standing,
        usable,
        tuple(messages),
    )


def _host_time(log: Log) -> tuple[np.ndarray, str]:
    """The sensor's stamps in seconds of the computer: a straight line through both."""
    if log.host_time_s is None:
        raise LogError("the log has no host time, so the sensor's clock cannot be held against it")
    sensor, host = log.time_s - log.time_s[0], log.host_time_s - log.host_time_s[0]
    centred = sensor - sensor.mean()
    slope = float(centred @ (host - host.mean()) / (centred @ centred))
    spread = float(np.std(host - slope * sensor))
    std = spread / float(np.sqrt(centred @ centred))
    said = (
        f"a second of the sensor is {slope:.9f} s of the computer (1σ {std * 1e6:.2g} ppm from the stamps' scatter); "
        "rates are integrated over the computer's time"
    )
    return log.time_s[0] + slope * sensor, said


def _temperature(built: Assembled, log: Log, unit: int) -> np.ndarray:
    maps = [m for m in (built.model.bias, built.model.scale) if m is not None]
    if log.temperature_c is not None and np.isfinite(log.temperature_c[unit]).any():
        values = log.temperature_c[unit]
        known = np.isfinite(values)
        return values if known.all() else np.interp(log.time_s, log.time_s[known], values[known])
    if any(m.temperature.size > 1 for m in maps) or built.model.has_gradient:
        raise LogError(
            "the log has no temperature, and the spec's maps depend on it: give them a temperature basis of degree 0"
        )
    return np.full(len(log.time_s), 20.0)


def table_axis_of(log: Log, axis: str, named: str | None) -> int | None:
    """Which of the table's axes turns a sensor's; None where the log has none. Raises `LogError` where unclear."""
    if named is not None:
        if named not in log.table_axes:
            raise LogError(f"the log has no table axis '{named}': it has {', '.join(log.table_axes) or 'none'}")
        return log.table_axes.index(named)
    if axis in log.table_axes:
        return log.table_axes.index(axis)
    if len(log.table_axes) == 1:
        return 0
    if not log.table_axes:
        return None
    raise LogError(
        f"which of the table's axes ({', '.join(log.table_axes)}) turns the sensor about {axis}? Say it with "
        "--table-axis"
    )


def followed(rows: Rows, lag: float) -> np.ndarray:
    """The temperature that the maps follow."""
    if lag <= 0.0:
        return rows.temperature
    return lagged(rows.temperature, float(np.mean(rows.step[1:])), lag)


def count_rows(log: Log, unit: int, used: np.ndarray) -> dict[str, int]:
    """Rows read by what became of them: ``used``, removed or masked by reason, or without a reference."""
    masked = log.counts(unit)
    usable = masked.pop("used")
    count = int(np.count_nonzero(used & log.usable(unit)))
    return {"used": count, "without a reference": usable - count, **masked}
