"""From the columns of a recording to a log: every row is used, masked or removed, and counted by its reason.

A row whose time stamp does not fit is removed; a row without a number, or marked, at full scale or with a false
temperature is masked; a gap begins a new stretch (`stamps`). What would need a guess is a question: stamps that are not
of one even clock, and values that no sensor has in the unit that the column map states. What channels show by
themselves is looked for where a log is used (`signal_checks`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from gradcal_jax.records.log import (
    Bools,
    Flags,
    Floats,
    Log,
    LogError,
    Reason,
    Whole,
    mean_interval,
    without_masked,
)
from gradcal_jax.records.signal_checks import frozen_temperature, jumped_temperature
from gradcal_jax.records.stamps import ABSURD, Findings, Policy, counted, rows_in_order, stretches

# Errors of a clock that are not a crystal's, and those of another rate.
_DRIFT, _OTHER_RATE = 50e-6, 0.2
_PLAUSIBLE: Final[Mapping[str, tuple[float, float, str]]] = {
    "interval": (2e-5, 1.5, "time stamps are {1:.3g} s apart: are they in another unit?"),
    "duration": (
        0.0,
        14 * 86400.0,
        "time stamps span {1:.3g} s: are they in another unit, or do they change to another clock, for example from "
        "the time since start to the time of day (read the parts with --rows)?",
    ),
    "rate": (0.0, 90.0, "the rates of {0} reach {1:.3g} rad/s: does the column map state a unit that is too large?"),
    "force": (2.0, 500.0, "the specific force of {0} is usually {1:.3g} m/s²: is its unit g, or counts?"),
    "temperature": (-100.0, 200.0, "the temperature of {0} is about {1:.0f} degC: is its unit K, degF, or counts?"),
    "noise": (
        0.0,
        float(np.radians(300.0)) / 60.0,
        "{0} has a noise of {1:.3g} rad/√s, and no gyro is so noisy: does the column map state rad/s instead of deg/s, "
        "or s instead of ms?",
    ),
    "clock": (
        1.0 - _OTHER_RATE,
        1.0 + _OTHER_RATE,
        "the intervals of the time stamps are {1:.6g} times those of the stated rate, {0}: are the time stamps in "
        "another unit, or clock ticks, or is only every n-th sample recorded?",
    ),
}
"""Of a statistic in SI the least and the largest value that a sensor has, and the question beyond these."""


@dataclass
class Columns:
    """The columns of a source in SI by their names, unchecked."""

    sensor: str
    """Name of the sensor."""
    values: dict[str, Floats]
    """`(rows,)`: "gyro x", "accelerometer x" (any axes), "temperature", "table angle x", "table
    rate x", "time" (absent: evenly sampled at `sample_rate_hz`), "host time", "marked", not 0 if the device marks its
    output as bad, and "standstill": truth values (counted up run by run) or numbers, negative while moving."""
    sample_rate_hz: float | None = None
    """The stated sample rate, if there is one."""
    full_scale_rad_per_s: float | None = None
    increments: tuple[str, ...] = ()
    """The columns of rates that hold the angles turned since the row before, rad."""
    left_out: int = 0
    """Rows of the source that are not among these."""
    rows_before: int = 0
    """Those of them before the first row here."""
    simulated: bool = False
    provenance: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def rows(self) -> int:
        """The number of rows."""
        return len(next(iter(self.values.values())))

    def part(self, rows: tuple[int, int | None]) -> "Columns":
        """The rows between two numbers alone, the last not included. Raises `LogError` where there are none."""
        part = self.of_rows(slice(*rows))
        if part.rows < 2:
            raise LogError(f"the part from row {rows[0]} on has fewer than two rows; the log has {self.rows} rows")
        return replace(part, rows_before=rows[0], left_out=self.rows - part.rows)

    def of_rows(self, kept: slice | Bools | Whole) -> "Columns":
        """The same of some rows."""
        return replace(self, values={name: array[kept] for name, array in self.values.items()})

    def measured(self, *kinds: str) -> dict[str, Floats]:
        """The columns whose names begin with one of the `kinds`, by name."""
        return {name: array for name, array in self.values.items() if name.startswith(kinds)}

    def stacked(self, kind: str) -> tuple[tuple[str, ...], Floats | None]:
        """The axes of a kind, and their values `(rows, axes)`."""
        own = self.measured(kind + " ")
        axes = tuple(name.removeprefix(kind + " ") for name in own)
        return axes, np.stack(list(own.values()), axis=-1) if own else None


_OF_SENSOR: Final = ("gyro ", "accelerometer ", "temperature")


def at_rows_with_rates(columns: Columns) -> Columns:
    """The rows in which all rates are given, with the other channels interpolated to their stamps; farther from a
    channel's own rows than three of its intervals it is missing. Raises `LogError` where there are no two rows with all
    rates."""
    rated = np.all([np.isfinite(rate) for rate in columns.measured("gyro ").values()], axis=0)
    if np.count_nonzero(rated) < 2:
        raise LogError(
            "interpolate: fewer than two rows have all rates; leave out channels with separate rows, or join the rows"
        )
    time: Floats = columns.values.get("time", np.arange(columns.rows, dtype=np.float64))
    joined = columns.of_rows(rated)
    for name, values in columns.measured(*_OF_SENSOR[1:], "table ").items():
        joined.values[name] = interpolated(values, time, time[rated])
    return replace(joined, left_out=columns.rows - joined.rows)


def interpolated(values: Floats, time: Floats, at: Floats) -> Floats:
    """Values `(n,)` at other times; NaN farther from the known ones than three of their intervals."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    if len(known) < 2:
        return np.full(len(at), np.nan)
    known = known[np.argsort(time[known], kind="stable")]
    x = time[known]
    near = np.searchsorted(x, at).clip(1, len(x) - 1)
    away = np.minimum(np.abs(at - x[near - 1]), np.abs(at - x[near]))
    return np.where(away <= 3.0 * np.median(np.diff(x)), np.interp(at, x, values[known]), np.nan)


def examine(columns: Columns, policy: Policy | None = None) -> Log:
    """The log of a source's columns, with every fault treated by the policy.

    Rows are removed only where their stamp is unusable; all others stay, or are masked. Every row is counted: used,
    masked and removed rows add up to the rows of the source.

    **Raises:** `LogError` where the policy refuses a fault, and where fewer than two rows are left.
    """
    found = Findings(policy or Policy())
    if columns.left_out:
        found.removed[Reason.LEFT_OUT.words] = columns.left_out
    kept = columns
    # Absurd numbers may overflow or divide by zero; the result is absurd too, and compared as such.
    with np.errstate(all="ignore"):
        if "time" in columns.values:
            kept = columns.of_rows(rows_in_order(columns.values["time"], found, columns.rows_before))
            time = kept.values["time"]
        elif columns.sample_rate_hz is None:
            raise LogError("the column map has neither a column of time stamps nor a sample rate: give one of them")
        else:
            time = np.arange(columns.rows) / columns.sample_rate_hz
        time, starts = stretches(time, found)
        interval = mean_interval(time, starts)
        rates = {name: kept.values[name] / interval for name in columns.increments}
        kept, status = _masked(replace(kept, values=kept.values | rates), time, starts, found)
        for name, value, what in _statistics(kept, time, interval, status == 0):
            low, high, question = _PLAUSIBLE[name]
            if not low <= value <= high:
                found.question("question", question.format(what, value))
            elif name == "clock" and abs(value - 1.0) > _DRIFT:
                ppm = (value - 1.0) * 1e6
                found.note("clock drift", f"the intervals of the time stamps are {ppm:+.0f} ppm longer than stated")
    (axes, gyros), (force_axes, forces) = kept.stacked("gyro"), kept.stacked("accelerometer")
    (angle_axes, angles), (rate_axes, table_rates) = kept.stacked("table angle"), kept.stacked("table rate")
    warm = kept.values.get("temperature")
    log = Log(
        time_s=time,
        rate_rad_per_s=np.zeros((1, len(time), 0)) if gyros is None else gyros[None],
        units=(columns.sensor,),
        axes=axes,
        temperature_c=None if warm is None else warm[None],
        table_axes=angle_axes or rate_axes,
        table_angle_rad=angles,
        table_rate_rad_per_s=table_rates,
        standstill=_numbered(kept.values.get("standstill")),
        host_time_s=kept.values.get("host time"),
        status=status[None],
        stretch_starts=starts,
        rows_read=columns.rows + columns.left_out,
        rows_removed=found.removed,
        findings=tuple(found),
        simulated=columns.simulated,
        provenance=columns.provenance,
        specific_force_m_per_s2=None if forces is None else forces[None],
        force_axes=force_axes,
    )
    return without_masked(log)


def _masked(columns: Columns, time: Floats, starts: Whole, found: Findings) -> tuple[Columns, Flags]:
    """The columns without values in rows that are marked, and the status of the rows."""
    status = np.zeros(len(time), np.uint16)

    def mask(reason: Reason, rows: Bools, words: str) -> None:
        # What is marked has no value, and lacks none.
        rows = rows & (status & Reason.MARKED.value == 0)
        if count := int(np.count_nonzero(rows)):
            found.note(reason.words, f"{counted(count)} {words}, first row {np.argmax(rows)}")
            status[rows] |= reason.value

    mask(Reason.MARKED, columns.values.get("marked", 0.0 * time) != 0.0, "marked bad by the device")
    own = {name: np.where(status != 0, np.nan, values) for name, values in columns.measured(*_OF_SENSOR).items()}
    columns = replace(columns, values=columns.values | own)
    full = (columns.full_scale_rad_per_s or np.inf) * (1 - 1e-9)
    for name, values in own.items():
        if name.startswith("gyro"):
            mask(Reason.MISSING_RATE, ~(np.abs(values) < ABSURD), f"without a rate ({name})")
            mask(Reason.SATURATED, np.abs(values) >= full, f"at full scale ({name})")
        elif name.startswith("accelerometer"):
            mask(Reason.MISSING_FORCE, ~(np.abs(values) < ABSURD), f"without a specific force ({name})")
    warm = own.get("temperature", time + np.nan)
    warm = np.where(np.abs(warm) < ABSURD, warm, np.nan)
    if not np.isfinite(warm).any():
        return columns, status  # (A sensor without a thermometer lacks none.)
    jumped = jumped_temperature(warm, starts)
    mask(Reason.MISSING_TEMPERATURE, ~np.isfinite(warm), "without a temperature")
    words = "with a temperature that jumps for a while, as if the thermometer restarted or lost contact"
    mask(Reason.MISSING_TEMPERATURE, jumped, words)
    warm[jumped] = np.nan
    frozen = frozen_temperature(time, warm, starts)
    if frozen[np.isfinite(warm)].all():
        text = "never changes: is it constant, or is the thermometer not connected?"
        found.note("constant temperature", f"the temperature of {columns.sensor} {text}")
    else:
        words = "with a constant temperature, although the temperature changes in the rest of the record"
        mask(Reason.FROZEN_TEMPERATURE, frozen, words)
    return columns, status


def _statistics(columns: Columns, time: Floats, interval: float, usable: Bools) -> Iterator[tuple[str, float, str]]:
    """The statistics of a recording that have a plausible range, with what they are of."""
    usual, stated = float(np.median(np.diff(time))), columns.sample_rate_hz
    if stated is None:
        yield "interval", usual, ""
        yield "duration", float(time[-1] - time[0]), ""
    elif "time" in columns.values:
        yield "clock", interval * stated, f"{stated:g} Hz"
    if not usable.any():
        return
    warm = columns.values.get("temperature", time + np.nan)[usable]
    if np.isfinite(warm).any():
        yield "temperature", float(np.nanmedian(warm)), columns.sensor
    axes, forces = columns.stacked("accelerometer")
    force = 0.0 if forces is None else float(np.median(np.linalg.norm(forces[usable], axis=1)))
    if len(axes) == 3 and force > 0.5:
        yield "force", force, columns.sensor
    for axis, rates in columns.measured("gyro ").items():
        rate, where = rates[usable], f"{axis} of {columns.sensor}"
        yield "rate", float(np.percentile(np.abs(rate), 99)), where
        yield "noise", _least_walk(rate, usual), where


def _least_walk(values: Floats, interval: float) -> float:
    """The least angle random walk (rad/√s) that neighbouring samples and neighbouring means of 8 and 64 allow.

    From the median of their differences, which is that of the quieter half: the other half may contain motion.
    """
    walks = list[float]()
    for size in (1, 8, 64):
        means = values[: len(values) // size * size].reshape(-1, size).mean(axis=1)
        if len(means) > 20:
            steps = np.diff(means)
            spread = 1.4826 * float(np.median(np.abs(steps - np.median(steps))))
            walks.append(spread * float(np.sqrt(size * interval / 2)))
    return min(walks, default=0.0)


def _numbered(standstill: Floats | None) -> Whole | None:
    """Numbers of standstills: from the source, or truth values counted up run by run; -1 while moving."""
    if standstill is None:
        return None
    known = np.where(np.isfinite(standstill), standstill, -1.0)
    if np.isin(known, (0.0, 1.0)).all():
        begins = np.diff(known, prepend=0.0) > 0.0
        return np.where(known == 1.0, np.cumsum(begins) - 1, -1)
    return np.maximum(np.rint(np.clip(known, -1, 2**53)), -1).astype(np.int64)
