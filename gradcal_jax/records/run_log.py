"""From a run's journal to a log: samples decoded from the raw bytes, readings and standstills from the events.

Only rows of stretches with data are kept; all others are counted as removed. A pause ends stretches and standstills,
because the state of the rig in it is unknown. In a standstill all axes stand. Every poll of an axis's angle is one
reading, at the row at whose end the axis stands there.

The time stamp of a row is the sensor's clock, aligned with the computer's where data begin. `host_time` is the
computer's clock, by a straight line through the quickest arrivals, whose slope and residuals are in the log's
provenance. Where a run was resumed or an IMU restarted, the computer's clock gives the length of the interruption.

The columns of the log are views of the samples' file, which is mapped into memory: a run of days takes no more memory
than one of an hour.
"""

import itertools
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.journal import Chunk, Event, JournalContents, records_of
from gradcal_jax.hardware.run_folder import SESSION, RunFolder, exit_status, rig_as_run
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records.alignment import Alignment, AngleTrack, align
from gradcal_jax.records.clockmap import ClockMap, bridge_gaps, fit_arrivals, last_of_chunks
from gradcal_jax.records.log import SERIAL_NUMBER, AngleReadings, Finding, Log, Reason
from gradcal_jax.records.samples import Rows, SampleFile, compacted
from gradcal_jax.records.sessions import Session, sessions_of
from gradcal_jax.records.table_angles import (
    MARGIN_S,
    MOVE_COMMANDS,
    SETTLED_S,
    held_rates,
    known_standstills,
    standstills,
    table_readings,
)
from gradcal_jax.spec.bench import RigTable
from gradcal_jax.spec.rig import ImuDevice, RigFile

# The length of an interruption that no clock measured.
_BETWEEN_SESSIONS_S: Final = 60.0
# A jump of the wall clock by less than this does not mean that the computer was off or asleep.
_CLOCK_SET_S: Final = 10.0
_FEWEST_ARRIVALS: Final = 3
Floats = NDArray[np.float64]


def log(
    folder: str | Path, unit: str | None = None, *, recording: Log | None = None, scratch: str | Path | None = None
) -> Log:
    """The log of a run, decoded from its journal's raw bytes: rates in rad/s, times in s, temperatures in °C, readings
    of the table's angles in rad, standstills.

    `unit`: the unit whose log is wanted, where the table carries several. `recording`: the unit's data in this run by
    another logger; its clock is aligned by the motion. `scratch`: where the samples lie, about as many bytes as the
    log has, as long as the log exists (default: the run's folder). Errors: `ValueError` where the folder is not a
    run's, or the recording is not of it; `HardwareError` where the journal holds no samples of a stretch with data.
    """
    run = RunFolder(Path(folder))
    about = {name: str(text) for name, text in run.notes().get("about", {}).items()}
    scratch = Path(folder if scratch is None else scratch)
    if recording is not None:
        of_run = _of_recording(run.events(), run.recipe(), run.rig(), recording, unit, scratch)
    else:
        events = (one for one in records_of(run.journal_path) if isinstance(one, Event) and one.name == SESSION)
        rig = rig_as_run(JournalContents(list(itertools.islice(events, 1))), run.rig())
        of_run = log_of_records(records_of(run.journal_path), run.recipe(), rig, unit, scratch)
    return replace(of_run, provenance={**about, **of_run.provenance})


def units_in(folder: str | Path) -> list[str | None]:
    """The names of the IMUs of a run that have logs; None where its only one needs no name."""
    names = [device.name for device in RunFolder(Path(folder)).rig().imu]
    return list(names) if len(names) > 1 else [None]


@dataclass
class _Part:
    """The rows of one session that count, from `first` to before `end` of the log's; their times are the session's."""

    session: Session
    clock: ClockMap
    ranges: list[tuple[int, int]]
    """Of the samples of the file."""
    sample_s: float
    read: int
    restarts: int = 0
    bad_bytes: int = 0
    first: int = 0
    end: int = 0


def log_of_records(
    records: Iterable[Event | Chunk], recipe: Recipe, rig: RigFile, unit: str | None, scratch: Path
) -> Log:
    """The log of a unit from all records of the journal; `rig`: as it was when the run began."""
    device = _device(rig, unit)
    names = [axis.name for axis in rig.axis]
    with SampleFile(scratch, table_axes=len(names)) as file:
        sessions = sessions_of(records, device, file)
        rows = file.rows()
    # The axes of the spec, in that order; a single axis may have another name.
    drawn = [axis.name for axis in recipe.spec.rig.table.axis]
    axes = _axes_of(sessions, drawn if set(drawn) <= set(names) else names)
    parts = [part for session in sessions if (part := _part_of(session, rows)) is not None]
    if not parts:
        raise HardwareError(
            "The journal has no samples to use: the run ended before the first part whose data are used."
        )
    provenance = {"unit": device.name, "driver": device.driver}
    events = (event for session in sessions for event in session.events)
    identities = (e.data for e in events if e.name == "identity" and e.data["device"] == device.name)
    if number := next((str(of["serial_number"]) for of in identities if of.get("serial_number")), ""):
        provenance[SERIAL_NUMBER] = number
    labels = _labels(axes, recipe, rig)
    made = _joined(rows, parts, axes, labels, device.serial_number or device.name, ("x", "y", "z"))
    return replace(made, provenance=_provenance(made, parts, sessions, recipe) | provenance)


def _part_of(session: Session, rows: Rows) -> _Part | None:
    """The samples of a session in stretches with data; None where there are too few."""
    stream = session.stream
    if stream is None or (decoder := stream.decoder) is None or not session.stretches():
        return None
    own = rows[stream.first : stream.end]
    bridge_gaps(own, decoder.round_samples * decoder.sample_s, decoder.sample_s)
    device, host = last_of_chunks(own["time_s"], own["host_s"])
    if len(device) < _FEWEST_ARRIVALS:
        return None
    resolution_s = max(decoder.resolution_s, time.get_clock_info("monotonic").resolution)
    clock = fit_arrivals(device, host, resolution_s=resolution_s)
    ranges = _ranges_that_count(session, own, clock, stream.first)
    if not ranges:
        return None
    restarts = int(np.count_nonzero(own["restarted"][1:]))
    counts = restarts, decoder.bad_bytes
    return _Part(session, clock, ranges, decoder.sample_s, len(own), *counts)


def _ranges_that_count(session: Session, own: Rows, clock: ClockMap, first: int) -> list[tuple[int, int]]:
    """The samples in stretches with data, which get the computer's times; none where there are fewer than two."""
    # (In place, and by comparisons: an array of all rows in memory is as large as they are many.)
    host = own["host_s"]
    np.multiply(own["time_s"], clock.rate, out=host)
    host += clock.offset_s
    kept = np.zeros(len(own), bool)
    for start_s, end_s in session.stretches():
        kept |= (host > start_s) & (host <= end_s)
    ranges = [(low, high) for low, high in (formulas.runs(kept) + first).tolist()]
    return ranges if np.count_nonzero(kept) > 1 else []


def _of_recording(
    contents: JournalContents, recipe: Recipe, rig: RigFile, recorded: Log, unit: str | None, scratch: Path
) -> Log:
    """The log of a unit that another logger recorded, with the run's table and chamber.

    Each session of the run is aligned with the recording by the motion (`alignment`). Temperatures are the
    recording's, or else the chamber's. Raises `HardwareError` where the run has no stretch with data, `NoAlignment` (a
    `ValueError`) where the recording does not show the run's motion.
    """
    rig = rig_as_run(contents, rig)
    number = recorded.unit_index(unit or 0)
    sessions = sessions_of(contents.records)
    axes = _axes_of(sessions, [axis.name for axis in rig.axis])
    labels = _labels(axes, recipe, rig)
    rates = {axis: np.degrees(recorded.rate_rad_per_s[number, :, k]) for k, axis in enumerate(recorded.axes)}
    if len(labels) == len(rates) == 1:
        # Both have one axis only: its name does not matter.
        rates = dict(zip(labels, rates.values(), strict=True))
    table = recipe.spec.rig.table
    turned = rates
    if not set(rates) & set(labels) and table.axis[-1].name in labels:
        turned = {table.axis[-1].name: _about_innermost(table, rates)}
    alignments: list[Alignment] = []
    recorded_in = [session for session in sessions if session.stretches()]
    with SampleFile(scratch, len(rates), len(rig.axis)) as file:
        for session in recorded_in:
            tracks = {label: _track(session.events, axis) for axis, label in zip(axes, labels, strict=True)}
            alignments.append(align(recorded.time_s, turned, tracks))
            file.write(_as_rows(recorded, number, alignments[-1], session.events, file.kind))
        rows = file.rows()
    parts: list[_Part] = []
    for place, (session, alignment) in enumerate(zip(recorded_in, alignments, strict=True)):
        first, end = place * len(recorded.time_s), (place + 1) * len(recorded.time_s)
        clock = _clock_of(alignment)
        if ranges := _ranges_that_count(session, rows[first:end], clock, first):
            parts.append(_Part(session, clock, ranges, recorded.sample_interval_s, end - first))
    if not parts:
        raise HardwareError("The recording has no samples from any part of the run whose data are used.")
    who = recorded.units[number]
    made = _joined(rows, parts, axes, labels, who, tuple(rates))
    provenance = _provenance(made, parts, sessions, recipe) | {"unit": who, "driver": "recorded elsewhere"}
    provenance["clock_offset_std_s"] = ", ".join(f"{one.offset_std_s:.1e}" for one in alignments)
    message = "; ".join(
        f"the recording's clock was determined from {one.readings} readings of {one.bursts} turns, to "
        f"{one.offset_std_s:.2g} s and {1e6 * one.rate_std:.2g} ppm (1σ; delays of the table's readings are not "
        "included)"
        for one in alignments
    )
    findings = (*made.findings, Finding("clock determined from the motion", "keep", 0, message))
    return replace(made, findings=findings, provenance=provenance)


def _about_innermost(table: RigTable, rates_dps: Mapping[str, Floats]) -> Floats:
    """The rate about the table's innermost axis, as an IMU senses it whose mounting at that time is not known yet."""
    names, turning = tuple(rates_dps), table.axis[-1].unit_vector
    along = np.array(
        [[np.dot(one.columns["xyz".index(name)], turning) for name in names] for one in table.mounting], np.float64
    )
    rates = np.stack(list(rates_dps.values()), axis=-1)
    rates = rates - np.nanmedian(rates, axis=0)
    if len(along) == 1:
        return rates @ along[0]
    fastest = np.abs(np.nan_to_num(rates)).argmax(axis=1)
    signs = np.sign(along[np.abs(along).argmax(axis=0), np.arange(len(names))])
    sensed = np.take_along_axis(rates, fastest[:, None], axis=1)[:, 0]
    return np.linalg.norm(rates, axis=1) * np.sign(sensed) * signs[fastest]


def _track(events: Sequence[Event], axis: str) -> AngleTrack:
    rows = [
        (float(e.data["time_s"]), float(e.data["position_deg"]))
        for e in events
        if e.name in ("angle", "track") and e.data["axis"] == axis and e.data["position_deg"] is not None
    ]
    times, angles = np.array(sorted(rows)).reshape(-1, 2).T
    # Two entries of one time are one reading. Homing, which may reset the count, precedes all data.
    first = np.append(True, np.diff(times) > 0.0)[: len(times)]
    return AngleTrack(times[first], angles[first])


def _as_rows(recorded: Log, number: int, clock: Alignment, events: Sequence[Event], kind: np.dtype[Any]) -> Rows:
    """The samples of a recording at the run's times. Temperatures are the recording's, or else the chamber's."""
    rows = np.zeros(len(recorded.time_s), kind)
    rows["time_s"] = recorded.time_s
    rows["host_s"] = clock.host_time_s(recorded.time_s)
    rows["rate"] = recorded.rate_rad_per_s[number]
    rows["force"] = rows["temperature_c"] = rows["second_c"] = np.nan
    if recorded.force_axes == ("x", "y", "z") and recorded.specific_force_m_per_s2 is not None:
        rows["force"] = recorded.specific_force_m_per_s2[number]
    if recorded.temperature_c is not None:
        rows["temperature_c"] = recorded.temperature_c[number]
    elif chamber := [event for event in events if event.name == "chamber"]:
        at_s = [event.time_s for event in chamber]
        loads = [event.data.get("product_c") for event in chamber]
        read_c = [float(e.data["air_c"] if load is None else load) for e, load in zip(chamber, loads, strict=True)]
        rows["temperature_c"] = np.interp(rows["host_s"], at_s, read_c)
    if (second := recorded.bridged_temperature(number, second=True)) is not None:
        rows["second_c"] = second
    if recorded.status is not None:
        rows["status"] = np.where(recorded.status[number] != 0, Reason.MARKED.value, 0)
    steps = np.diff(recorded.time_s, prepend=recorded.time_s[0])
    rows["gap"] = np.maximum(np.round(steps / recorded.sample_interval_s).astype(np.int64) - 1, 0)
    return rows


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
        raise HardwareError(f"Which IMU? The run has {', '.join(names) or 'none'}.")
    return rig.imu[names.index(unit)]


def _axes_of(sessions: Sequence[Session], names: Sequence[str]) -> list[str]:
    """The rig's axes with a command of motion or a reading; nothing depends on the others."""
    active = {
        str(e.data["axis"]) for session in sessions for e in session.events if e.name in ("angle", *MOVE_COMMANDS)
    }
    return [name for name in names if name in active]


def _labels(axes: Sequence[str], recipe: Recipe, rig: RigFile) -> tuple[str, ...]:
    """The axes' names in the log: the recipe's where recipe and rig have one axis each, else the rig's."""
    turned = {move.axis for block in recipe.motion for move in block.moves if move.do not in ("rest", "wait")}
    return tuple(turned) if len(axes) == len(rig.axis) == len(turned) == 1 else tuple(axes)


def _joined(
    rows: Rows, parts: Sequence[_Part], axes: Sequence[str], labels: tuple[str, ...], unit: str, gyros: tuple[str, ...]
) -> Log:
    """The log of the samples in the ranges of the parts, which are moved to the beginning of `rows`."""
    read = len(rows)
    starts: list[int] = []
    count = 0
    for part in parts:
        part.first = count
        for low, high in part.ranges:
            starts.append(count)
            count += high - low
        part.end = count
    rows = compacted(rows, [some for part in parts for some in part.ranges])
    broken = np.flatnonzero((rows["gap"] > 0) | rows["restarted"])
    readings: list[AngleReadings] = []
    since_s: list[Floats] = []
    standing, spins = 0, True
    rows["standstill"] = -1
    for part in parts:
        own, events = rows[part.first : part.end], part.session.events
        host = own["host_s"].copy()
        for first_s, mounting in part.session.mountings():
            own["mounting"][int(np.searchsorted(host, first_s)) :] = mounting - 1
        for low, high in _standing(part, host, axes):
            own["standstill"][low:high] = standing
            standing += 1
        late_s = part.sample_s + part.clock.residual_max_s
        of_axes = [table_readings(events, axis, k, host, late_s) for k, axis in enumerate(axes)]
        of_part = AngleReadings.in_order(of_axes)
        readings.append(replace(of_part, row=of_part.row + part.first))
        since_s.append(of_part.time_s - host[of_part.row])
        held = [held_rates(events, axis, float(host[-1])) for axis in axes]
        for k, knots in enumerate(held):
            own["table_rate"][:, k] = 0.0 if knots is None else np.radians(np.interp(host, *knots))
        spins = spins and any(knots is not None for knots in held)
    _place(rows, parts)
    # The reading's time by the rows' two clocks, which differ by less than a part in a thousand.
    placed = [replace(r, time_s=rows["time_s"][r.row] + s) for r, s in zip(readings, since_s, strict=True)]
    return Log(
        time_s=rows["time_s"],
        rate_rad_per_s=rows["rate"][None],
        units=(unit,),
        axes=gyros,
        temperature_c=rows["temperature_c"][None],
        table_axes=labels,
        table_rate_rad_per_s=rows["table_rate"][:, : len(axes)] if spins else None,
        standstill=rows["standstill"],
        mounting=rows["mounting"] if np.all(rows["mounting"] >= 0) else None,
        host_time_s=rows["host_s"],
        status=rows["status"][None],
        stretch_starts=np.union1d(starts, broken).astype(np.int64),
        rows_read=read,
        rows_removed={"not in a stretch of data": read - count} if read > count else {},
        findings=_findings(rows, parts),
        simulated=any(part.session.simulated for part in parts),
        specific_force_m_per_s2=rows["force"][None] if np.isfinite(rows["force"]).any() else None,
        force_axes=("x", "y", "z") if np.isfinite(rows["force"]).any() else (),
        readings=AngleReadings.in_order(placed) if labels else None,
        second_temperature_c=rows["second_c"][None] if np.isfinite(rows["second_c"]).any() else None,
    )


def _standing(part: _Part, host: Floats, axes: Sequence[str]) -> list[tuple[int, int]]:
    """First row of every standstill of known angles, and the row after its last one."""
    # The stamps are as uncertain as the residuals of the clocks' line: a row may be earlier or later by that much.
    unsure_s = part.clock.residual_max_s
    times = np.array(standstills(part.session.events, axes)).reshape(-1, 2)
    low = np.searchsorted(host, times[:, 0] + SETTLED_S + part.sample_s + unsure_s)
    high = np.searchsorted(host, times[:, 1] - MARGIN_S - unsure_s)
    # Of a standstill that a pause cut short no row may be left.
    low, high = low[low < high], high[low < high]
    known = np.ones(len(low), bool)
    for axis in axes:
        known &= known_standstills(part.session.events, axis, host[low], host[high - 1])
    return list(zip(low[known].tolist(), high[known].tolist(), strict=True))


def _place(rows: Rows, parts: Sequence[_Part]) -> None:
    """All parts on the clocks of the first.

    The computer's clock continues in the next session, unless the computer was restarted or slept in between: the wall
    clock then gives the difference. The log's clock is the sensor's; the computer's gives the begin of the first part
    and the distance between two parts.
    """
    shift_s, begins_s = 0.0, float(rows["host_s"][0])
    for number, part in enumerate(parts):
        own = rows[part.first : part.end]
        if number:
            before = parts[number - 1]
            stood_s = part.session.origin_s - before.session.origin_s
            # Simulated devices run on their own clock, which is independent of the wall clock.
            if stood_s > _CLOCK_SET_S and not part.session.simulated:
                shift_s += stood_s
            last = rows[before.end - 1]
            apart_s = float(own["host_s"][0] - last["host_s"]) + shift_s
            if apart_s <= 0.0:
                shift_s += _BETWEEN_SESSIONS_S - apart_s
                apart_s = _BETWEEN_SESSIONS_S
            begins_s = float(last["time_s"]) + apart_s
        own["time_s"] -= float(own["time_s"][0])
        own["time_s"] += begins_s
        own["host_s"] += shift_s


def _findings(rows: Rows, parts: Sequence[_Part]) -> tuple[Finding, ...]:
    broken = np.setdiff1d(np.flatnonzero(rows["gap"] > 0), [part.first for part in parts])
    missing, gaps = int(rows["gap"][broken].sum()), len(broken)
    unsure = max(part.clock.residual_max_s for part in parts)
    anew, bad = (sum(getattr(p, name) for p in parts) for name in ("restarts", "bad_bytes"))
    refused = sum(part.session.refused() for part in parts)
    lateness = (
        f"the computer was so busy that its time stamps are accurate only to {unsure:.2g} s: as an additional "
        "margin, this time is left out at both ends of every standstill"
    )
    times = f"{anew} time{'s' * (anew > 1)} during the run; the samples lost in a restart are not counted as missing"
    attempts = "attempts at a step that the run itself did not accept are left out: see the journal for the reasons"
    all_of = (
        (gaps, Finding("gap", "split", gaps, f"about {missing} samples are missing at {gaps} places")),
        (unsure > SETTLED_S, Finding("late stamps", "mask", 0, lateness)),
        (anew, Finding("unit restarted", "split", anew, f"the IMU restarted {times}")),
        (bad, Finding("unreadable bytes", "keep", 0, f"{bad} bytes belong to no valid datagram")),
        (refused, Finding("refused attempt", "mask", refused, attempts)),
    )
    return tuple(finding for there, finding in all_of if there)


def _provenance(log: Log, parts: Sequence[_Part], sessions: Sequence[Session], recipe: Recipe) -> dict[str, str]:
    clocks = [part.clock for part in parts]
    entries: dict[str, Any] = {
        "recipe": recipe.fingerprint,
        "title": recipe.title or "",
        "run": exit_status(JournalContents([event for session in sessions for event in session.events])),
        "sessions": len(sessions),
        "simulated": "the devices were simulated" if log.simulated else "no",
        "clock_from_row": ", ".join(str(part.first) for part in parts),
        "clock_rate_error": ", ".join(f"{clock.rate_error:.3e}" for clock in clocks),
        "clock_rate_std": ", ".join(f"{clock.rate_std:.1e}" for clock in clocks),
        "clock_residual_rms_s": ", ".join(f"{clock.residual_rms_s:.1e}" for clock in clocks),
        "seams": sum(event.name == "seam" for session in sessions for event in session.events),
    }
    return {name: str(value) for name, value in entries.items()}
