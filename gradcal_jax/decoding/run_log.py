"""From a run's journal to a log: samples decoded from the raw bytes, angles and standstills from the events.

Only rows of stretches with data are kept; soaks, waiting times, everything before a stretch and pauses are counted as
removed. A pause ends stretches and standstills, because the state of the rig in it is unknown. In a standstill all axes
stand. Every poll of an axis's angle is one reading, at the row at whose end the axis stands there.

Between readings the angle is a reconstruction, for pictures: in a standstill the nearest reading; an axis that a motor
turns follows the commanded trapezoid between its readings before and after; every other angle is interpolated linearly.

The time stamp of a row is the sensor's clock, aligned with the computer's where data begin. `host_time` is the
computer's clock, by a straight line through the quickest arrivals, whose slope and residuals are in the log's
provenance. Where a run was resumed or a unit restarted, the computer's clock gives the length of the interruption.
"""

import itertools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..files.log import SERIAL_NUMBER, AngleReadings, Finding, Log, Reason
from ..files.recipe import Recipe
from ..files.rig import ImuDevice, RigFile
from ..files.unit_spec import UnitSpec
from ..hardware.errors import HardwareError
from ..hardware.journal import Chunk, Event, JournalContents, records_of
from ..hardware.roles import STANDARD_GRAVITY, ImuBatch, ImuDecoder, join
from ..hardware.run_folder import SESSION, RunFolder, exit_status, rig_as_run
from ..hardware.setup import config_of, driver_of
from ..hardware.stretches import breaks_off
from .alignment import Alignment, AngleTrack, align
from .clockmap import ClockMap, fit_clock
from .counter_wraps import Doubt, wraps_resolved
from .table_angles import MARGIN_S, MOVE_COMMANDS, SETTLED_S, RunAngles, standstills, table_angles

# The length of an interruption that no clock measured.
_BETWEEN_SESSIONS_S: Final = 60.0
# A jump of the wall clock by less than this does not mean that the computer was off or asleep.
_CLOCK_SET_S: Final = 10.0
_FEWEST_ARRIVALS: Final = 3
Floats = NDArray[np.float64]


@dataclass
class _Session:
    """One part of a run: its records in order. It began at `begun_s` of the run's clock, in the `mounting` of that
    number, from 1; 0: the operator was never asked to mount the units."""

    number: int
    simulated: bool
    wall_clock_s: float
    begun_s: float
    mounting: int
    events: list[Event] = field(default_factory=list[Event])
    stream: "_Stream | None" = None
    """The unit's own samples."""

    @property
    def origin_s(self) -> float:
        """The wall clock's time at zero of the run's clock."""
        return self.wall_clock_s - self.begun_s


def log(folder: str | Path, unit: str | None = None, *, recording: Log | None = None) -> Log:
    """The log of a run, decoded from its journal's raw bytes: rates in rad/s, times in s, temperatures in °C, the
    table's angles in rad, standstills.

    `unit`: the unit whose log is wanted, where the table carries several. `recording`: the unit's data in this run by
    another logger; its clock is aligned by the motion. Errors: `ValueError` where the folder is not a run's, or the
    recording is not of it; `HardwareError` where the journal holds no samples of a stretch with data.
    """
    run = RunFolder(Path(folder))
    about = {name: str(text) for name, text in run.notes().get("about", {}).items()}
    if recording is not None:
        decoded = log_of_recording(run.events(), run.recipe(), run.rig(), recording, unit)
    else:
        decoded = log_of(run.events(), run.recipe(), run.rig(), unit, records=records_of(run.journal_path))
    return replace(decoded, provenance={**about, **decoded.provenance})


def log_of(
    contents: JournalContents,
    recipe: Recipe,
    rig: RigFile,
    unit: str | None = None,
    *,
    records: Iterable[Event | Chunk] | None = None,
) -> Log:
    """The log of one unit (by name; None: the rig's only one), decoded with the configuration in the journal.

    `records`: all records, one by one, where `contents` has the events alone. Raises `HardwareError` where the journal
    holds no samples of a stretch with data."""
    rig = rig_as_run(contents, rig)
    device = _device(rig, unit)
    parts: list[_Part] = []
    aside = 0
    sessions = _sessions(contents.records if records is None else records, device)
    names = [axis.name for axis in rig.axis]
    if isinstance(recipe.spec, UnitSpec):
        # A whole unit's table has the axes of its spec, in that order; a single axis may have another name.
        drawn = [axis.name for axis in recipe.spec.rig.table.axis]
        names = drawn if set(drawn) <= set(names) else names
    axes = _axes_of(sessions, names)
    for session in sessions:
        kept, left = _parts(session, axes)
        parts += kept
        aside += left
    if not parts:
        raise HardwareError(
            "The journal holds no samples of a stretch with data: the run ended before its first stretch began."
        )
    provenance = _provenance(parts, sessions, recipe, (device.name, device.driver), exit_status(contents))
    identities = (e.data for e in contents.events if e.name == "identity" and e.data["device"] == device.name)
    if number := next((str(of["serial_number"]) for of in identities if of.get("serial_number")), ""):
        provenance[SERIAL_NUMBER] = number
    return _joined(parts, _labels(axes, recipe, rig), device.serial_number or device.name, provenance, aside)


def log_of_recording(contents: JournalContents, recipe: Recipe, rig: RigFile, recorded: Log, unit: str | None) -> Log:
    """The log of a unit that another logger recorded, with the run's table and chamber.

    Each part of the run is aligned with the recording by the motion (`alignment`). Temperatures are the recording's,
    or else the chamber's. Raises `HardwareError` where the run has no stretch with data, `NoAlignment` (a `ValueError`)
    where the recording does not show the run's motion.
    """
    rig = rig_as_run(contents, rig)
    number = recorded.unit_index(unit or 0)
    sessions = _sessions(contents.records)
    axes = _axes_of(sessions, [axis.name for axis in rig.axis])
    labels = _labels(axes, recipe, rig)
    rates = {axis: np.degrees(recorded.rate_rad_per_s[number, :, k]) for k, axis in enumerate(recorded.axes)}
    if len(labels) == len(rates) == 1:
        # Both have one axis only: its name does not matter.
        rates = dict(zip(labels, rates.values(), strict=True))
    parts: list[_Part] = []
    alignments: list[Alignment] = []
    for session in sessions:
        if _stretches(session.events):
            tracks = {label: _track(session.events, axis) for axis, label in zip(axes, labels, strict=True)}
            alignments.append(align(recorded.time_s, rates, tracks))
            samples = _as_samples(recorded, number, rates, alignments[-1], session.events)
            part = _part_with_table(session, samples, _clock_of(alignments[-1]), axes, recorded.sample_interval_s)
            parts += [] if part is None else [part]
    if not parts:
        raise HardwareError("The recording holds no samples of a stretch of the run with data.")
    who = recorded.units[number]
    provenance = _provenance(parts, sessions, recipe, (who, "recorded elsewhere"), exit_status(contents))
    provenance["clock_offset_std_s"] = ", ".join(f"{one.offset_std_s:.1e}" for one in alignments)
    log = _joined(parts, labels, who, provenance, 0, tuple(rates))
    message = "; ".join(
        f"the recording's clock is known by {one.readings} readings of {one.bursts} turns to {one.offset_std_s:.2g} s "
        f"and {1e6 * one.rate_std:.2g} ppm (1σ), delays of the table's readings not reckoned"
        for one in alignments
    )
    return replace(log, findings=(*log.findings, Finding("clock found by the motion", "keep", 0, message)))


def _track(events: Sequence[Event], axis: str) -> AngleTrack:
    """All readings of an axis's angle, in order."""
    rows = [
        (float(e.data["time_s"]), float(e.data["position_deg"]))
        for e in events
        if e.name in ("angle", "track") and e.data["axis"] == axis and e.data["position_deg"] is not None
    ]
    times, angles = np.array(sorted(rows)).reshape(-1, 2).T
    # Two entries of one time are one reading. Homing, which may reset the count, precedes all data.
    first = np.append(True, np.diff(times) > 0.0)[: len(times)]
    return AngleTrack(times[first], angles[first])


def _as_samples(
    recorded: Log, number: int, rates: Mapping[str, Floats], clock: Alignment, events: Sequence[Event]
) -> ImuBatch:
    count = len(recorded.time_s)
    host = clock.host_time_s(recorded.time_s)
    temperature = np.full(count, np.nan)
    if recorded.temperature_c is not None:
        temperature = np.asarray(recorded.temperature_c[number], np.float64)
    elif chamber := [event for event in events if event.name == "chamber"]:
        at_s = np.array([event.time_s for event in chamber])
        loads = [event.data.get("product_c") for event in chamber]
        read_c = [float(e.data["air_c"] if load is None else load) for e, load in zip(chamber, loads, strict=True)]
        temperature = np.interp(host, at_s, np.array(read_c))
    steps = np.diff(recorded.time_s, prepend=recorded.time_s[0])
    missing = np.maximum(np.round(steps / recorded.sample_interval_s).astype(np.int64) - 1, 0)
    status = np.zeros(count, np.int64) if recorded.status is None else recorded.status[number].astype(np.int64)
    none = np.zeros(count, bool)
    return ImuBatch(
        host,
        recorded.time_s,
        np.stack(list(rates.values()), axis=-1),
        np.full((count, 3), np.nan),
        np.repeat(temperature[:, None], 3, axis=1),
        np.zeros((count, 3), np.int32),
        status,
        missing,
        none,
        none,
    )


def _clock_of(alignment: Alignment) -> ClockMap:
    """The alignment as the line of a stream's clock: five sigmas are removed at both ends of a rest."""
    offset_s = alignment.offset_s - alignment.rate * alignment.middle_s
    std_s = alignment.offset_std_s
    return ClockMap(offset_s, alignment.rate, alignment.rate_std, std_s, 5.0 * std_s, alignment.readings, 0)


def _device(rig: RigFile, unit: str | None) -> ImuDevice:
    names = [device.name for device in rig.imu]
    if unit is None and len(names) == 1:
        return rig.imu[0]
    if unit not in names:
        raise HardwareError(f"Which unit? The run has {', '.join(names) or 'none'}.")
    return rig.imu[names.index(unit)]


def _sessions(records: Iterable[Event | Chunk], device: ImuDevice | None = None) -> list[_Session]:
    """The sessions of a run, with the samples of a unit, which are decoded as they are read."""
    sessions: list[_Session] = []
    mounting = 0
    for record in records:
        if isinstance(record, Event):
            if record.name == SESSION:
                data = record.data
                wall_clock_s, simulated = float(data["wall_clock_s"]), bool(data["simulated"])
                sessions.append(_Session(int(data["number"]), simulated, wall_clock_s, record.time_s, mounting))
                sessions[-1].stream = None if device is None else _Stream(device)
            elif record.name == "hung":
                mounting = int(record.data["mounting"])
            if sessions:
                sessions[-1].events.append(record)
                if (stream := sessions[-1].stream) is not None and record.name == "configuration":
                    stream.configure(record)
        elif sessions and record.received and (stream := sessions[-1].stream) is not None:
            stream.push(record)
    return sessions


# Batches that are joined at once, so that no small arrays are kept.
_TOGETHER: Final = 4096


class _Stream:
    """The samples of a unit in a session: only what a log needs, in as few bytes as hold it exactly."""

    def __init__(self, device: ImuDevice) -> None:
        self._device = device
        self._early: list[Chunk] = []
        self._small: list[ImuBatch] = []
        self._blocks: list[ImuBatch] = []
        self.decoder: ImuDecoder | None = None

    def configure(self, event: Event) -> None:
        """The decoder is that of the unit's first configuration in the session."""
        if event.data["device"] != self._device.name or self.decoder is not None:
            return
        config = config_of(self._device, "imu", ("imu", self._device.name))
        driver = driver_of(self._device.driver)
        assert driver is not None
        self.decoder = driver.load().decoder_of(config, event.data["registers"])
        for chunk in self._early:
            self.push(chunk)
        self._early.clear()

    def push(self, chunk: Chunk) -> None:
        if chunk.line != self._device.name:
            return
        if self.decoder is None:
            self._early.append(chunk)
            return
        self._small.append(self.decoder.push(chunk.data, chunk.time_s))
        if len(self._small) == _TOGETHER:
            self._pack()

    def samples(self) -> ImuBatch:
        """All of them; this object forgets them."""
        self._pack()
        blocks, self._blocks = self._blocks, []
        fields: dict[str, Any] = {}
        for name in ImuBatch.__dataclass_fields__:
            fields[name] = np.concatenate([getattr(block, name) for block in blocks])
            # One quantity at a time is there twice.
            blocks = [replace(block, **{name: np.zeros(0)}) for block in blocks]
        return ImuBatch(**fields)

    def _pack(self) -> None:
        batch, self._small = join(self._small), []
        if not len(batch) and self._blocks:
            return
        packed = {name: _packed(getattr(batch, name)) for name in ("gyro_dps", "acceleration_g")}
        packed |= {name: getattr(batch, name).astype(np.int32) for name in ("status", "gap_before")}
        packed["temperature_c"] = batch.temperature_c.mean(axis=1, keepdims=True)
        self._blocks.append(replace(batch, raw_gyro=np.zeros((len(batch), 0), np.int32), **packed))


def _packed(values: Floats) -> Any:
    """As numbers of four bytes where these are the same."""
    small = values.astype(np.float32)
    return small if np.array_equal(small, values, equal_nan=True) else values


def _axes_of(sessions: Sequence[_Session], names: Sequence[str]) -> list[str]:
    """The rig's axes with a command of motion or a reading; nothing depends on the others."""
    active = {
        str(e.data["axis"]) for session in sessions for e in session.events if e.name in ("angle", *MOVE_COMMANDS)
    }
    return [name for name in names if name in active]


def _labels(axes: Sequence[str], recipe: Recipe, rig: RigFile) -> tuple[str, ...]:
    """The axes' names in the log: the recipe's where recipe and rig have one axis each, else the rig's."""
    turned = {move.axis for block in recipe.motion for move in block.moves if move.do not in ("rest", "wait")}
    return tuple(turned) if len(axes) == len(rig.axis) == len(turned) == 1 else tuple(axes)


# ------------------------------------------------------------------------------------------------------ one session


@dataclass
class _Part:
    """The rows of one session that count, on the session's clock; of several where the unit began anew in it."""

    session: _Session
    samples: ImuBatch
    device_s: Floats
    host_s: Floats
    clock: ClockMap
    table: RunAngles
    standstill: NDArray[np.int64]
    mounting: NDArray[np.int64]
    starts: list[int]
    read: int
    missing: int
    doubts: tuple[tuple[float, Doubt], ...] = ()
    restarted: bool = False
    round_samples: int = 0
    bad_bytes: int = 0
    repeated: int = 0


def _parts(session: _Session, axes: Sequence[str]) -> tuple[list[_Part], int]:
    """The parts of a session, and the number of samples in streams without a usable part."""
    stream = session.stream
    if stream is None or (decoder := stream.decoder) is None:
        return [], 0
    samples = stream.samples()
    parts: list[_Part] = []
    aside = 0
    starts = np.flatnonzero(samples.restarted[1:]) + 1
    for begin, end in itertools.pairwise([0, *starts.tolist(), len(samples)]):
        part = _part(session, decoder, _subset(samples, slice(begin, end)), axes)
        if part is None:
            aside += end - begin
        else:
            parts.append(replace(part, restarted=begin > 0))
    if parts:
        # The decoder counts for the whole session, and the counts of all parts are added.
        parts[0] = replace(parts[0], bad_bytes=decoder.bad_bytes, repeated=decoder.repeated_datagrams)
    return parts, aside


def _part(session: _Session, decoder: ImuDecoder, samples: ImuBatch, axes: Sequence[str]) -> _Part | None:
    """The samples of a unit from its start on; None where there are none."""
    if not _stretches(session.events) or len(np.unique(samples.host_time_s)) < _FEWEST_ARRIVALS:
        return None
    samples, doubts = wraps_resolved(samples, decoder.round_samples, decoder.sample_s)
    resolution_s = max(decoder.resolution_s, time.get_clock_info("monotonic").resolution)
    clock = fit_clock(samples.device_time_s, samples.host_time_s, resolution_s=resolution_s)
    part = _part_with_table(session, samples, clock, axes, decoder.sample_s)
    if part is None:
        return None
    after_s = clock.host_time_s(samples.device_time_s) - float(part.host_s[0])
    placed = tuple((float(after_s[doubt.row]), doubt) for doubt in doubts)
    return replace(part, doubts=placed, round_samples=decoder.round_samples)


def _part_with_table(
    session: _Session, samples: ImuBatch, clock: ClockMap, axes: Sequence[str], sample_s: float
) -> _Part | None:
    """The samples in stretches with data, with the table's motion; None where there are none."""
    host = clock.host_time_s(samples.device_time_s)
    kept = np.zeros(len(samples), bool)
    for start, end in _stretches(session.events):
        kept |= (host > start) & (host <= end)
    rows = np.flatnonzero(kept)
    if len(rows) < 2:
        return None
    broken = np.diff(rows, prepend=rows[0] - 2) > 1
    missing = samples.gap_before[rows]
    starts = np.flatnonzero(broken | (missing > 0))
    at_s = host[rows]
    standing = standstills(session.events, axes)
    number = np.full(len(rows), -1, np.int64)
    # The stamps are as uncertain as the residuals of the clocks' line: a row may be earlier or later by that much.
    unsure_s = clock.residual_max_s
    for place, (start, end) in enumerate(standing):
        begin, over = start + SETTLED_S + sample_s + unsure_s, end - MARGIN_S - unsure_s
        first, last = np.searchsorted(at_s, [begin, over])
        number[first : max(first, last)] = place
    table = table_angles(session.events, axes, at_s, number, sample_s + unsure_s)
    number[~np.isfinite(table.course_deg).all(axis=-1)] = -1
    # Numbered anew: of a standstill that a pause cut short no row may be left.
    left = np.unique(number[number >= 0])
    number[number >= 0] = np.searchsorted(left, number[number >= 0])
    # Where the rows that count have no hole they are not copied.
    together = len(rows) == rows[-1] - rows[0] + 1
    return _Part(
        session,
        _subset(samples, slice(int(rows[0]), int(rows[-1]) + 1) if together else rows),
        samples.device_time_s[rows],
        at_s,
        clock,
        table,
        number,
        _mountings(session, at_s),
        [int(start) for start in starts],
        len(samples),
        int(np.maximum(missing[1:], 0).sum()),
    )


def _subset(samples: ImuBatch, rows: NDArray[np.int64] | slice) -> ImuBatch:
    return ImuBatch(**{name: getattr(samples, name)[rows] for name in ImuBatch.__dataclass_fields__})


def _stretches(events: Sequence[Event]) -> list[tuple[float, float]]:
    """From the beginning of a step with data to its end, or to the end of the run or session."""
    intervals: list[tuple[float, float]] = []
    open_since: float | None = None
    latest = 0.0
    for event in events:
        latest = max(latest, event.time_s)
        if event.name == "step begins" and event.data.get("data"):
            begin = float(event.data["begins_s"])
            if open_since is None:
                open_since = begin
        elif open_since is not None and (event.name == "step" or breaks_off(event)):
            # A step that follows at once continues the stretch: its "step begins" has the same time.
            intervals.append((open_since, event.time_s))
            open_since = None
    if open_since is not None:
        intervals.append((open_since, latest))
    merged: list[tuple[float, float]] = []
    for start, end in intervals:
        joins = bool(merged) and start - merged[-1][1] < 1e-3
        merged.append((merged.pop()[0], end) if joins else (start, end))
    return merged


def _mountings(session: _Session, host: Floats) -> NDArray[np.int64]:
    """The number of the mounting of every row, from 1; 0 where the operator was never asked to mount the units."""
    hung = [(event.time_s, int(event.data["mounting"])) for event in session.events if event.name == "hung"]
    numbers = np.array([session.mounting, *(number for _, number in hung)], np.int64)
    return numbers[np.searchsorted(np.array([time for time, _ in hung]), host, side="right")]


# ------------------------------------------------------------------------------------------------------------ joined


def _joined(
    parts: Sequence[_Part],
    labels: tuple[str, ...],
    unit: str,
    provenance: dict[str, str],
    aside: int,
    axes: tuple[str, ...] = ("x", "y", "z"),
) -> Log:
    times: list[Floats] = []
    standstills: list[NDArray[np.int64]] = []
    starts: list[int] = []
    readings: list[AngleReadings] = []
    row, numbered = 0, 0
    hosts = _on_one_clock(parts)
    for place, (part, host) in enumerate(zip(parts, hosts, strict=True)):
        # The sensor's seconds; the computer's give the begin of the first part and the distance between two parts.
        begins_s = float(times[-1][-1] + host[0] - hosts[place - 1][-1]) if place else float(host[0])
        times.append(part.device_s - part.device_s[0] + begins_s)
        standstills.append(np.where(part.standstill >= 0, part.standstill + numbered, -1))
        numbered += int(part.standstill.max(initial=-1)) + 1
        starts += sorted({row, *(row + start for start in part.starts)})
        # The reading's time by the rows' two clocks, which differ by less than a part in a thousand.
        own = part.table.readings
        since = own.time_s - part.host_s[own.row]
        readings.append(replace(own, time_s=times[-1][own.row] + since, row=own.row + row))
        row += len(host)
    findings, provenance = _findings(parts), dict(provenance)
    samples = join([part.samples for part in parts]) if len(parts) > 1 else parts[0].samples
    for part in parts:
        # A log of a day is as large as they are.
        part.samples = join([])
    marked = np.where(samples.status != 0, np.uint16(Reason.MARKED.value), np.uint16(0))
    read = aside + sum(part.read for part in parts)
    temperature = samples.temperature_c.mean(axis=1)
    rate, force = samples.gyro_dps.astype(np.float64), samples.acceleration_g.astype(np.float64)
    del samples
    np.radians(rate, out=rate)
    force *= STANDARD_GRAVITY
    forced = bool(np.isfinite(force).any())
    mounting = _one([part.mounting for part in parts])
    return Log(
        time_s=_one(times),
        rate_rad_per_s=rate[None],
        units=(unit,),
        axes=axes,
        specific_force_m_per_s2=force[None] if forced else None,
        force_axes=("x", "y", "z") if forced else (),
        temperature_c=temperature[None],
        table_axes=labels,
        table_course_rad=np.radians(_one([part.table.course_deg for part in parts])) if labels else None,
        table_rate_rad_per_s=np.radians(np.concatenate(rates)) if (rates := _rates(parts)) else None,
        readings=AngleReadings.in_order(readings) if labels else None,
        standstill=_one(standstills),
        mounting=mounting - 1 if mounting.all() else None,
        host_time_s=_one(hosts),
        status=marked[None],
        stretch_starts=np.array(starts, np.int64),
        rows_read=read,
        rows_removed={"not in a stretch of data": read - row} if read > row else {},
        findings=findings,
        simulated=any(part.session.simulated for part in parts),
        provenance=provenance,
    )


def _one(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """The arrays one after the other; a single one is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _rates(parts: Sequence[_Part]) -> list[Floats]:
    """The held rates of all parts, deg/s, where an axis spins."""
    rates = [part.table.rates_dps for part in parts]
    return [own for own in rates if own is not None] if all(own is not None for own in rates) else []


def _on_one_clock(parts: Sequence[_Part]) -> list[Floats]:
    """The computer's times of all rows, on the clock of the first session.

    That clock continues in the next session, unless the computer was restarted or slept in between: the wall clock then
    gives the difference.
    """
    hosts = [parts[0].host_s]
    shift_s = 0.0
    for before, part in itertools.pairwise(parts):
        end_s = float(hosts[-1][-1])
        stood_s = part.session.origin_s - before.session.origin_s
        # Simulated devices run on their own clock, which is independent of the wall clock.
        if stood_s > _CLOCK_SET_S and not part.session.simulated:
            shift_s += stood_s
        apart_s = float(part.host_s[0]) + shift_s - end_s
        if apart_s <= 0.0:
            again = part.session is before.session
            least_s = float(part.device_s[1] - part.device_s[0]) if again else _BETWEEN_SESSIONS_S
            shift_s += least_s - apart_s
        hosts.append(part.host_s + shift_s)
    return hosts


def _findings(parts: Sequence[_Part]) -> tuple[Finding, ...]:
    missing = sum(part.missing for part in parts)
    gaps = sum(int(np.count_nonzero(part.samples.gap_before[1:])) for part in parts)
    unsure = max(part.clock.residual_max_s for part in parts)
    anew = sum(part.restarted for part in parts)
    bad, twice = (sum(getattr(part, name) for part in parts) for name in ("bad_bytes", "repeated"))
    lateness = f"the computer was so busy that its stamps are sure to {unsure:.2g} s only: so much more is left away"
    times = f"{anew} time{'s' * (anew > 1)} in the run; what it would have sent is not counted"
    others = [
        (unsure > SETTLED_S, Finding("late stamps", "mask", 0, f"{lateness} at both ends of every standstill")),
        (anew, Finding("unit restarted", "split", anew, f"the unit began anew {times}")),
        (bad, Finding("unreadable bytes", "keep", 0, f"{bad} bytes belong to no sound datagram")),
        (twice, Finding("repeated datagram", "keep", 0, f"{twice} datagrams came twice and count once")),
    ]
    findings = [Finding("gap", "split", gaps, f"{missing} samples are missing in {gaps} places")] if missing else []
    findings += _findings_of_rounds(parts)
    return (*findings, *(one for there, one in others if there))


def _findings_of_rounds(parts: Sequence[_Part]) -> Iterator[Finding]:
    """Places with an uncertain number of missing samples: each kind with its first place."""
    for traced, kind in ((True, "gap of doubtful length"), (False, "stamps that come later")):
        places = [(part, *doubt) for part in parts for doubt in part.doubts if doubt[1].traced == traced]
        if places:
            part, first_s, first = places[0]
            samples = part.round_samples
            message = (
                f"{len(places)} of the gaps may be longer or shorter by a round of the counter ({samples} samples)"
                if traced
                else f"in {len(places)} places {samples} samples or a multiple of it may be missing; none are counted"
            )
            where = f"the first {abs(first_s):.1f} s {'before' if first_s < 0.0 else 'after'} data begin: {first.why}"
            yield Finding(kind, "split" if traced else "keep", len(places), f"{message}; {where}")


def _provenance(
    parts: Sequence[_Part], sessions: Sequence[_Session], recipe: Recipe, unit: tuple[str, str], status: str
) -> dict[str, str]:
    first_rows = itertools.accumulate((len(part.host_s) for part in parts[:-1]), initial=0)
    entries: dict[str, Any] = {
        "recipe": recipe.fingerprint,
        "title": recipe.title or "",
        "run": status,
        "sessions": len(sessions),
        "unit": unit[0],
        "driver": unit[1],
        "simulated": "the devices were simulated" if any(p.session.simulated for p in parts) else "no",
        "clock_from_row": ", ".join(str(row) for row in first_rows),
        "clock_rate_error": ", ".join(f"{part.clock.rate_error:.3e}" for part in parts),
        "clock_rate_std": ", ".join(f"{part.clock.rate_std:.1e}" for part in parts),
        "clock_residual_rms_s": ", ".join(f"{part.clock.residual_rms_s:.1e}" for part in parts),
        "seams": sum(event.name == "seam" for session in sessions for event in session.events),
    }
    return {name: str(value) for name, value in entries.items()}
