"""From the columns of a recording to a log: every row is used, masked or removed, and counted by its reason.

A row whose time stamp does not fit is removed; a row without a number, or marked, saturated or frozen, is masked; a gap
begins a new stretch (`stamps`, `signal_checks`). What would need a guess is a question: stamps that are not of one even
clock, and values that no sensor has in the unit that the column map states.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from gradcal_jax.records.log import Bools, Floats, Log, LogError, Reason, Whole, mean_interval, without_masked
from gradcal_jax.records.signal_checks import at_a_limit, frozen_temperature, jumped_temperature, wrapped
from gradcal_jax.records.stamps import ABSURD, Findings, Policy, counted, rows_in_order, stretches, wander

# Clock errors: possible with any crystal, and no clock error.
_DRIFT, _OTHER_RATE = 50e-6, 0.2
# Between units that are taken for one another.
_FACTORS: Final = (180 / np.pi, 60.0, 1e3, 3600.0)
_PLAUSIBLE: Final[Mapping[str, tuple[float, float, str]]] = {
    "interval": (2e-5, 1.5, "time stamps are {1:.3g} s apart: are they in another unit?"),
    "duration": (0.0, 14 * 86400.0, "time stamps span {1:.3g} s: are they in another unit?"),
    "rate": (0.0, 90.0, "the rates of {0} reach {1:.3g} rad/s: does the column map state a unit that is too large?"),
    "force": (2.0, 500.0, "the specific force of {0} is usually {1:.3g} m/s²: is its unit g, or counts?"),
    "temperature": (-100.0, 200.0, "the temperature of {0} is about {1:.0f} degC: is its unit K, degF, or counts?"),
    "noise": (
        0.0,
        float(np.radians(300.0)) / 60.0,
        "{0} has a noise of {1:.3g} rad/√s, and no gyro is so noisy: does the column map state rad/s instead of deg/s, "
        "or s instead of ms?",
    ),
    "turns": (
        1.0,
        1.0,
        "{0} measures {1:.4g} times the rate of the table: is a unit wrong (deg instead of rad, per hour or per minute "
        "instead of per second)?",
    ),
}
"""Of a statistic in SI the least and the largest value that a sensor has, and the question beyond these."""


@dataclass
class Columns:
    """The columns of a source in SI by their names, unchecked."""

    units: tuple[str, ...]
    """Names of the sensors."""
    values: dict[str, Floats]
    """`(units, rows)`: "gyro x", "accelerometer x" (any axes), "temperature", "second temperature", and "marked", not 0
    if the device marks its output as bad. `(rows,)`: "time" (absent: evenly sampled at `sample_rate_hz`), "host time",
    "table angle x", "table rate x", and "standstill": truth values (counted up run by run) or numbers, negative while
    moving."""
    sample_rate_hz: float | None = None
    """The stated sample rate, if there is one."""
    full_scale_rad_per_s: float | None = None
    rows_before: int = 0
    """Number of rows of the source before the first row here."""
    rows_after: int = 0
    simulated: bool = False
    provenance: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def rows(self) -> int:
        """The number of rows."""
        return next(iter(self.values.values())).shape[-1]

    def part(self, rows: tuple[int, int | None]) -> "Columns":
        """The rows between two numbers alone, the last not included. Raises `LogError` where there are none."""
        first, last = rows[0], self.rows if rows[1] is None else min(rows[1], self.rows)
        if last - first < 2:
            raise LogError(f"the part from row {first} on has fewer than two rows; the log has {self.rows} rows")
        return replace(self.of_rows(slice(first, last)), rows_before=first, rows_after=self.rows - last)

    def of_rows(self, kept: slice | Bools | Whole) -> "Columns":
        """The same of some rows."""
        return replace(self, values={name: array[..., kept] for name, array in self.values.items()})

    def measured(self, *kinds: str) -> dict[str, Floats]:
        """The columns whose names begin with one of the `kinds`, by name."""
        return {name: array for name, array in self.values.items() if name.startswith(kinds)}

    def stacked(self, kind: str, unit: int | None = None) -> tuple[tuple[str, ...], Floats | None]:
        """The axes of a kind, and their values along a last dimension, of all units or one."""
        own = {name.removeprefix(kind + " "): values for name, values in self.measured(kind + " ").items()}
        if not own:
            return (), None
        return tuple(own), np.stack([values if unit is None else values[unit] for values in own.values()], axis=-1)


CHANNELS: Final = ("gyro ", "accelerometer ", "temperature", "second temperature", "table angle ", "table rate ")


def at_rows_with_rates(columns: Columns) -> Columns:
    """The rows in which all rates are given, with the other channels interpolated to their stamps; farther from a
    channel's own rows than three of its intervals it is missing. Rows of one stamp, each of other channels, are one.
    Raises `LogError` where there are no two rows with all rates."""
    columns = _of_one_stamp(columns)
    rated = _finite(columns.measured("gyro "), np.all)
    if np.count_nonzero(rated) < 2:
        raise LogError(
            "interpolate: fewer than two rows have all rates; leave out channels with separate rows, or join the rows"
        )
    time: Floats = columns.values.get("time", np.arange(columns.rows, dtype=np.float64))
    joined = columns.of_rows(rated)
    for name, values in columns.measured(*CHANNELS[1:]).items():
        each = [interpolated(one, time, time[rated]) for one in np.atleast_2d(values)]
        joined.values[name] = np.stack(each).reshape(*values.shape[:-1], -1)
    return replace(joined, rows_after=columns.rows - joined.rows)


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


def _of_one_stamp(columns: Columns) -> Columns:
    """Rates that stand in rows of their own joined where rows in succession have one stamp and no rate twice."""
    rates, time = columns.measured("gyro "), columns.values.get("time")
    if time is None or _finite(rates, np.all).all():
        return columns
    begins = np.flatnonzero(np.diff(time, prepend=np.nan) != 0.0)
    joined = dict[str, Floats]()
    for name, rate in rates.items():
        if np.any(np.add.reduceat(np.isfinite(rate), begins, axis=1, dtype=int) > 1):
            return columns
        joined[name] = rate.copy()
        joined[name][:, begins] = np.fmax.reduceat(rate, begins, axis=1)
    return replace(columns, values=columns.values | joined)


def _finite(channels: Mapping[str, Floats], which: Any) -> Bools:
    """`(rows,)`: rows in which all (`np.all`) or any (`np.any`) of the channels of all units have a number."""
    return which([which(np.isfinite(np.atleast_2d(values)), axis=0) for values in channels.values()], axis=0)


def examine(columns: Columns, policy: Policy | None = None) -> Log:
    """The log of a source's columns, with every fault treated by the policy.

    Rows are removed only where their stamp is unusable; all others stay, masked unit by unit. Every row is counted: for
    every unit, used, masked and removed rows add up to the rows of the source.

    **Raises:** `LogError` where the policy refuses a fault, and where fewer than two rows are left.
    """
    found = Findings(policy or Policy())
    outside = columns.rows_before + columns.rows_after
    if outside:
        found.removed[Reason.LEFT_OUT.words] = outside
    # Absurd numbers may overflow or divide by zero; the result is absurd too, and compared as such.
    with np.errstate(all="ignore"):
        kept, time = _timed(_with_values(columns, found), found)
        time, starts = stretches(time, found)
        kept, status = _masked(kept, time, starts, found)
        for name, value, what in _statistics(kept, time, starts, status == 0):
            low, high, question = _PLAUSIBLE[name]
            if not low <= value <= high:
                found.question("question", question.format(what, value))
        _compare_clocks(kept, time, starts, found)
    axes, rates = kept.stacked("gyro")
    force_axes, forces = kept.stacked("accelerometer")
    angle_axes, angles = kept.stacked("table angle")
    rate_axes, table_rates = kept.stacked("table rate")
    log = Log(
        time_s=time,
        rate_rad_per_s=np.zeros((*status.shape, 0)) if rates is None else rates,
        units=columns.units,
        axes=axes,
        temperature_c=kept.values.get("temperature"),
        table_axes=angle_axes or rate_axes,
        table_angle_rad=angles,
        table_rate_rad_per_s=table_rates,
        standstill=_numbered(kept.values.get("standstill")),
        host_time_s=kept.values.get("host time"),
        status=status,
        stretch_starts=starts,
        rows_read=columns.rows + outside,
        rows_removed=found.removed,
        findings=tuple(found),
        simulated=columns.simulated,
        provenance=dict(columns.provenance),
        specific_force_m_per_s2=forces,
        force_axes=force_axes,
        second_temperature_c=kept.values.get("second temperature"),
    )
    return without_masked(log)


def _with_values(columns: Columns, found: Findings) -> Columns:
    """Without rows of channels that the map does not name, if they are many: they are no rows of the record."""
    held = _finite(columns.measured(*CHANNELS), np.any)
    count = int(np.count_nonzero(~held))
    if "time" not in columns.values or count < max(20, 0.1 * len(held)) or len(held) - count < 2:
        return columns
    found.removed["empty row"] = count
    found.rows("empty row", count, f"{counted(count)} have no value in any column of the map, and are left out")
    return columns.of_rows(held)


def _timed(columns: Columns, found: Findings) -> tuple[Columns, Floats]:
    """The rows whose stamps increase, and these stamps."""
    if "time" in columns.values:
        columns = columns.of_rows(rows_in_order(columns.values["time"], found, columns.rows_before))
        return columns, columns.values["time"]
    if columns.sample_rate_hz is None:
        raise LogError("the column map has neither a column of time stamps nor a sample rate: give one of them")
    return columns, np.arange(columns.rows) / float(columns.sample_rate_hz)


def _masked(columns: Columns, time: Floats, starts: Whole, found: Findings) -> tuple[Columns, Any]:
    """The columns without values in rows that are masked whatever they hold, and the status of every unit's rows."""
    status = np.zeros((len(columns.units), len(time)), np.uint16)

    def mask(reason: Reason, rows: Bools, words: str) -> None:
        count = int(np.count_nonzero(rows))
        if count:
            first = int(np.argwhere(rows)[0][1])
            found.rows(reason.words, count, f"{counted(count)} {words}, first row {first}")
            status[rows] |= reason.value

    if "marked" in columns.values:
        mask(Reason.MARKED, columns.values["marked"] != 0, "marked bad by the device")
    whole = status != 0
    # What is masked whatever it holds has no value, and lacks none.
    own = {name: np.where(whole, np.nan, values) for name, values in columns.measured(*CHANNELS[:4]).items()}
    columns = replace(columns, values=columns.values | own)

    def lacking(kind: str) -> Bools:
        known = np.ones_like(whole)
        for values in columns.measured(kind).values():
            known &= np.abs(values) < ABSURD
        return ~known & ~whole

    mask(Reason.MISSING_RATE, lacking("gyro "), "without a rate")
    limit, over = np.zeros_like(whole), np.zeros_like(whole)
    full = columns.full_scale_rad_per_s
    for rates in columns.measured("gyro ").values():
        for unit, rate in enumerate(rates):
            limit[unit] |= at_a_limit(rate) if full is None else np.abs(rate) >= full * (1 - 1e-9)
            over[unit] |= wrapped(rate)
    mask(Reason.SATURATED, limit, "at full scale, or stuck at the largest or smallest rate of the record")
    words = "whose rate wrapped at full scale, from one end of its range to the other: choose a larger full scale"
    mask(Reason.SATURATED, over, words)
    mask(Reason.MISSING_FORCE, lacking("accelerometer "), "without a specific force")
    for unit, warm in enumerate(own.get("temperature", ())):
        known = np.where(np.abs(warm) < ABSURD, warm, np.nan)
        if not np.isfinite(known).any():
            continue  # (A sensor without a thermometer lacks none.)
        here = (np.arange(len(status)) == unit)[:, None]
        missing = ~np.isfinite(known) & ~whole[unit]
        jumped = jumped_temperature(known, starts)
        mask(Reason.MISSING_TEMPERATURE, here & missing, "without a temperature")
        words = "with a temperature that jumps for a while, as if the thermometer restarted or lost contact"
        mask(Reason.MISSING_TEMPERATURE, here & jumped, words)
        known[jumped] = np.nan
        frozen = frozen_temperature(time, known, starts)
        if frozen[np.isfinite(known)].all():
            text = "never changes: is it constant, or is the thermometer not connected?"
            found.note("constant temperature", f"the temperature of {columns.units[unit]} {text}")
        else:
            words = "with a constant temperature, although the temperature changes in the rest of the record"
            mask(Reason.FROZEN_TEMPERATURE, here & frozen, words)
    return columns, status


def _statistics(columns: Columns, time: Floats, starts: Whole, usable: Bools) -> Iterator[tuple[str, float, str]]:
    """The statistics of a recording that have a plausible range, with what they are of."""
    interval = float(np.median(np.diff(time)))
    longest = float(np.max(np.diff(time)))
    if columns.sample_rate_hz is None:
        if interval < 1.5 and longest > max(0.5 * (time[-1] - time[0]), 14 * 86400.0):
            raise LogError(
                f"time stamps jump by {longest:.6g} s after row {np.argmax(np.diff(time))}: do they change to another "
                "clock, for example from the time since start to the time of day? Read the parts with --rows"
            )
        yield "interval", interval, ""
        yield "duration", float(time[-1] - time[0]), ""
    turns = columns.measured("table rate ")
    for name, angle in () if turns else columns.measured("table angle ").items():
        turns[name] = np.gradient(angle, time)
    for unit, name in enumerate(columns.units):
        rows = usable[unit]
        if not rows.any():
            continue
        warm = columns.values["temperature"][unit, rows] if "temperature" in columns.values else np.zeros(0)
        if np.isfinite(warm).any():
            yield "temperature", float(np.nanmedian(warm)), name
        axes, forces = columns.stacked("accelerometer", unit)
        if forces is not None:
            usual = float(np.median(np.linalg.norm(forces[rows], axis=1)))
            if len(axes) == 3 and usual > 0.5:
                yield "force", usual, name
        for axis, rates in columns.measured("gyro ").items():
            rate, where = rates[unit, rows], f"{axis} of {name}"
            yield "rate", float(np.percentile(np.abs(rate), 99)), where
            yield "noise", _least_walk(rate, interval), where
            for turned in turns.values():
                if ratio := _factor(rate, turned[rows]):
                    yield "turns", ratio, where


def _factor(rate: Floats, turned: Floats) -> float:
    """The rate of a sensor axis over that of a table axis of the same motion, where it is a factor between units, or
    0."""
    known = np.isfinite(turned)
    if np.count_nonzero(known) < 10:
        return 0.0
    turned, rate = turned[known] - turned[known].mean(), rate[known] - rate[known].mean()
    along, power = abs(float(turned @ rate)), float(np.sqrt((turned @ turned) * (rate @ rate)))
    if not 0.0 < power < np.inf or along < 0.98 * power:
        return 0.0
    ratio = along / float(turned @ turned)
    mistaken = any(abs(one * factor - 1.0) < 0.05 for factor in _FACTORS for one in (ratio, 1.0 / ratio))
    return ratio if mistaken else 0.0


def _compare_clocks(columns: Columns, time: Floats, starts: Whole, found: Findings) -> None:
    """The intervals of the stamps against the stated ones, each other, and the sensor's clock against the "
    "computer's."""
    within = np.delete(np.diff(time), starts[1:] - 1)
    stated, host = columns.sample_rate_hz, columns.values.get("host time")
    if stated is not None and "time" in columns.values:
        ratio = mean_interval(time, within) * stated
        usual = float(np.median(np.diff(time))) * stated
        text = f"the intervals of the time stamps are {usual:.6g} times those of the stated rate, {stated:g} Hz"
        if abs(ratio - 1.0) > _OTHER_RATE:
            asks = ": are the time stamps in another unit, or clock ticks, or is only every n-th sample recorded?"
            found.question("question", text + asks)
        elif abs(ratio - 1.0) > _DRIFT:
            found.note("clock drift", f"{text}: {(ratio - 1.0) * 1e6:+.0f} ppm longer on average")
    if host is not None and bool(np.all(np.abs(host) < ABSURD)) and len(host) > 2:
        x, y = time - time.mean(), host - host.mean()
        slope = float(x @ y / (x @ x))
        # Stamps of the host jitter by milliseconds: only a larger deviation is drift.
        uncertain = float(np.std(y - slope * x) / (np.std(x) * np.sqrt(len(x))))
        if abs(slope - 1) > _DRIFT + 3 * uncertain and slope > 0:
            text = f"the sensor's clock is {(1 / slope - 1) * 1e6:+.0f} ppm fast relative to the computer's"
            found.note("clock drift", text)
    varies = wander(within)
    if varies > _DRIFT:
        found.note("clock drift", f"the sample interval varies by {varies * 1e6:.0f} ppm (rms) during the record")


def _least_walk(values: Floats, interval: float) -> float:
    """The least angle random walk (rad/√s) that neighbouring samples and neighbouring means of 8 and 64 allow.

    From the median of their differences, which is that of the quieter half: the other half may contain motion.
    """
    walks = [0.0]
    for size in (1, 8, 64):
        means = values[: len(values) // size * size].reshape(-1, size).mean(axis=1)
        if len(means) > 20:
            steps = np.diff(means)
            spread = 1.4826 * float(np.median(np.abs(steps - np.median(steps))))
            walks.append(spread * float(np.sqrt(size * interval / 2)))
    return min(walks[1:], default=0.0)


def _numbered(standstill: Floats | None) -> Whole | None:
    """Numbers of standstills: from the source, or truth values counted up run by run; -1 while moving."""
    if standstill is None:
        return None
    known = np.where(np.isfinite(standstill), standstill, -1.0)
    if np.isin(known, (0.0, 1.0)).all():
        still = known == 1.0
        begins = still & ~np.append(False, still[:-1])
        return np.where(still, np.cumsum(begins) - 1, -1)
    return np.maximum(np.rint(np.clip(known, -1, 2**53)), -1).astype(np.int64)
