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

import time
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.journal import Chunk, Event, records_of
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records.alignment import AngleTrack, NoAlignment, align
from gradcal_jax.records.clockmap import ClockMap, bridge_gaps, fit_arrivals, last_of_chunks
from gradcal_jax.records.log import SERIAL_NUMBER, AngleReadings, Finding, Log, Reason
from gradcal_jax.records.sessions import Rows, SampleFile, Session, compacted, sessions_of
from gradcal_jax.records.table_angles import (
    MARGIN_S,
    MOVE_COMMANDS,
    SETTLED_S,
    course_of,
    held_rates,
    standstills,
    table_readings,
)
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
    rig = run.rig_begun()
    scratch = Path(folder if scratch is None else scratch)
    if recording is not None:
        of_run = _log_of_recording(run.events().records, run.recipe(), rig, recording, unit, scratch)
    else:
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
    first: int = 0
    end: int = 0


def log_of_records(
    records: Iterable[Event | Chunk], recipe: Recipe, rig: RigFile, unit: str | None, scratch: Path
) -> Log:
    """The log of a unit from all records of the journal; `rig`: as it was when the run began."""
    device = _device(rig, unit)
    names = [axis.name for axis in rig.axis]
    file = SampleFile(scratch, table_axes=len(names))
    sessions = sessions_of(records, device, file)
    rows = file.rows()
    parts = [part for session in sessions if (part := _part_of(session, rows)) is not None]
    # The axes of the spec, in that order; a single axis may have another name.
    drawn = [axis.name for axis in recipe.spec.rig.table.axis]
    axes = _axes_of(sessions, drawn if set(drawn) <= set(names) else names)
    provenance = {"unit": device.name, "driver": device.driver}
    events = (event for session in sessions for event in session.events)
    identities = (e.data for e in events if e.name == "identity" and e.data["device"] == device.name)
    if number := next((str(of["serial_number"]) for of in identities if of.get("serial_number")), ""):
        provenance[SERIAL_NUMBER] = number
    made = _joined(rows, parts, axes, _labels(axes, recipe, rig), device.serial_number or device.name, ("x", "y", "z"))
    return replace(made, provenance=_provenance(parts, sessions, recipe) | provenance)


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


def _part_of(session: Session, rows: Rows) -> _Part | None:
    """The samples of a session in stretches with data; None where there are too few."""
    own = rows[slice(*session.samples)]
    if (decoder := session.decoder) is None or not session.stretches():
        return None
    bridge_gaps(own, decoder.round_samples * decoder.sample_s, decoder.sample_s)
    device, host = last_of_chunks(own["time_s"], own["host_s"])
    if len(device) < _FEWEST_ARRIVALS:
        return None
    resolution_s = max(decoder.resolution_s, time.get_clock_info("monotonic").resolution)
    clock = fit_arrivals(device, host, resolution_s=resolution_s)
    return _counting(session, own, clock, session.samples[0], decoder.sample_s)


def _counting(session: Session, own: Rows, clock: ClockMap, first: int, sample_s: float) -> _Part | None:
    """The samples in stretches with data, which get the computer's times; None where there are fewer than two."""
    # (In place, and by comparisons: an array of all rows in memory is as large as they are many.)
    host = own["host_s"]
    np.multiply(own["time_s"], clock.rate, out=host)
    host += clock.offset_s
    kept = np.zeros(len(own), bool)
    for start_s, end_s in session.stretches():
        kept |= (host > start_s) & (host <= end_s)
    ranges = [(low, high) for low, high in (formulas.runs(kept) + first).tolist()]
    return _Part(session, clock, ranges, sample_s) if np.count_nonzero(kept) > 1 else None


def _joined(
    rows: Rows, parts: Sequence[_Part], axes: Sequence[str], labels: tuple[str, ...], unit: str, gyros: tuple[str, ...]
) -> Log:
    """The log of the samples in the ranges of the parts, which are moved to the beginning of `rows`."""
    if not parts:
        raise HardwareError("There are no samples to use: none is from a part of the run whose data are used.")
    read = len(rows)
    ranges = [some for part in parts for some in part.ranges]
    starts = np.cumsum([0, *(high - low for low, high in ranges)])[:-1]
    count = 0
    for part in parts:
        part.first = count
        count = part.end = count + sum(high - low for low, high in part.ranges)
    rows = compacted(rows, ranges)
    rows["standstill"] = -1
    # Of each reading the time since the end of its row, the row, the axis, the angle and the kind.
    readings = [np.zeros((0, 5))]
    standing, spins = 0, True
    for part in parts:
        own, events = rows[part.first : part.end], part.session.events
        # (A view: searches are by `bisect`, because those of NumPy copy it whole.)
        host = own["host_s"]
        for first_s, mounting in part.session.mountings():
            own["mounting"][bisect_left(host, first_s) :] = mounting - 1
        courses = [course_of(events, axis) for axis in axes]
        # The stamps are as uncertain as the residuals of the clocks' line: a row may be earlier or later by that much.
        unsure_s = part.clock.residual_max_s
        for start_s, end_s in standstills(courses, max((event.time_s for event in events), default=0.0)):
            low = bisect_left(host, start_s + SETTLED_S + part.sample_s + unsure_s)
            high = bisect_left(host, end_s - MARGIN_S - unsure_s)
            # Of a standstill that a pause cut short no row may be left.
            if low < high:
                own["standstill"][low:high] = standing
                standing += 1
        spins = spins and any(course.spins for course in courses)
        for k, course in enumerate(courses):
            time_s, row, angle, kind = table_readings(course, host, part.sample_s + unsure_s).T
            since_s = time_s - host[row.astype(np.int64)]
            readings.append(np.column_stack([since_s, row + part.first, np.full(len(row), k), angle, kind]))
            # (Only where it is kept: arrays of all rows in memory.)
            if spins:
                own["table_rate"][:, k] = held_rates(course, host)
    _place(rows, parts)
    since_s, row, axis, angle, kind = np.concatenate(readings).T
    at, axis, kind = (column.astype(np.int64) for column in (row, axis, kind))
    # The reading's time by the rows' two clocks, which differ by less than a part in a thousand.
    time_s = rows["time_s"][at] + since_s
    order = np.argsort(time_s, kind="stable")
    none = np.full(len(at), np.nan)
    ordered = AngleReadings(time_s[order], at[order], axis[order], angle[order], none, kind[order])
    has_forces = any(np.isfinite(rows["force"][:, k]).any() for k in range(3))
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
        stretch_starts=np.union1d(starts, np.flatnonzero((rows["gap"] > 0) | rows["restarted"])).astype(np.int64),
        rows_read=read,
        rows_removed={"not in a stretch of data": read - count} if read > count else {},
        findings=_findings(rows, parts),
        simulated=any(part.session.simulated for part in parts),
        specific_force_m_per_s2=rows["force"][None] if has_forces else None,
        force_axes=("x", "y", "z") if has_forces else (),
        readings=ordered if labels else None,
    )


def _place(rows: Rows, parts: Sequence[_Part]) -> None:
    """All parts on the clocks of the first.

    The computer's clock continues in the next session, unless the computer was restarted or slept in between: the wall
    clock then gives the difference. The log's clock is the sensor's; the computer's gives the begin of the first part
    and the distance between two parts.
    """
    shift_s, begins_s = 0.0, float(rows["host_s"][0])
    for before, part in zip([None, *parts], parts, strict=False):
        own = rows[part.first : part.end]
        if before is not None:
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
    firsts = [part.first for part in parts]
    broken = np.setdiff1d(np.flatnonzero(rows["gap"] > 0), firsts)
    missing = int(rows["gap"][broken].sum())
    anew = len(np.setdiff1d(np.flatnonzero(rows["restarted"]), firsts))
    unsure_s = max(part.clock.residual_max_s for part in parts)
    bad = sum(part.session.decoder.bad_bytes for part in parts if part.session.decoder is not None)
    found = (
        (
            len(broken),
            "gap",
            f"about {missing} samples are missing at {len(broken)} places",
        ),
        (
            int(unsure_s > SETTLED_S),
            "late stamps",
            f"the computer was so busy that its time stamps are accurate only to {unsure_s:.2g} s: as an additional "
            "margin, this time is left out at both ends of every standstill",
        ),
        (
            anew,
            "unit restarted",
            f"the IMU restarted {anew} time{'s' * (anew > 1)} during the run; the samples lost in a restart are not "
            "counted as missing",
        ),
        (bad, "unreadable bytes", f"{bad} bytes belong to no valid datagram"),
        (
            sum(part.session.count("not done") for part in parts),
            "refused attempt",
            "attempts at a step that the run itself did not accept are left out: see the journal for the reasons",
        ),
    )
    return tuple(Finding(kind, message) for count, kind, message in found if count)


def _provenance(parts: Sequence[_Part], sessions: Sequence[Session], recipe: Recipe) -> dict[str, str]:
    clocks = [part.clock for part in parts]
    entries: dict[str, Any] = {
        "recipe": recipe.fingerprint,
        "sessions": len(sessions),
        "clock_from_row": ", ".join(str(part.first) for part in parts),
        "clock_rate_error": ", ".join(f"{clock.rate - 1.0:.3e}" for clock in clocks),
        "clock_rate_std": ", ".join(f"{clock.rate_std:.1e}" for clock in clocks),
        "seams": sum(session.count("seam") for session in sessions),
    }
    return {name: str(value) for name, value in entries.items()}


# ------------------------------------------------------------------------------------------ another logger's recording


def _log_of_recording(
    records: Iterable[Event | Chunk], recipe: Recipe, rig: RigFile, recorded: Log, unit: str | None, scratch: Path
) -> Log:
    """The log of a unit that another logger recorded, with the run's table and chamber.

    The recording is aligned by the motion (`alignment`). Temperatures are the recording's, or else the chamber's.
    Raises `HardwareError` where the run has not one session with data, `NoAlignment` (a `ValueError`) where the
    recording does not show the run's motion.
    """
    number = recorded.unit_index(unit or 0)
    with_data = [session for session in sessions_of(records) if session.stretches()]
    if len(with_data) != 1:
        raise HardwareError(
            "Only a run of one session with data can be aligned with another logger's recording; this one has "
            f"{len(with_data)}: make a run for each recording."
        )
    (session,) = with_data
    axes = _axes_of(with_data, [axis.name for axis in rig.axis])
    labels = _labels(axes, recipe, rig)
    tracks = [_track(session.events, axis) for axis in axes]
    if not tracks or len(recipe.spec.rig.table.mounting) > 1:
        raise NoAlignment("a recording is aligned with a run that turns an axis of its table, in one mounting")
    track = max(tracks, key=lambda one: float(np.abs(np.diff(one.angle_deg)).sum()))
    by_motion = align(recorded.time_s, np.degrees(recorded.rate_rad_per_s[number]), track)
    # The alignment as the line of a stream's clock: five sigmas are removed at both ends of a rest.
    offset_s, unsure_s = by_motion.offset_s - by_motion.rate * by_motion.middle_s, by_motion.offset_std_s
    clock = ClockMap(offset_s, by_motion.rate, by_motion.rate_std, 5.0 * unsure_s)
    file = SampleFile(scratch, len(recorded.axes), len(rig.axis))
    file.write(_as_rows(recorded, number, file.kind))
    rows = file.rows()
    rows["temperature_c"] = _chamber(session.events, offset_s + clock.rate * rows["time_s"], rows["temperature_c"])
    part = _counting(session, rows, clock, 0, recorded.sample_interval_s)
    parts = [] if part is None else [part]
    who = recorded.units[number]
    names = labels if len(labels) == len(recorded.axes) == 1 else recorded.axes
    made = _joined(rows, parts, axes, labels, who, names)
    provenance = _provenance(parts, with_data, recipe) | {"unit": who, "driver": "recorded elsewhere"}
    message = (
        f"the recording's clock was determined from {by_motion.readings} readings of {by_motion.turns} turns, to "
        f"{unsure_s:.2g} s and {1e6 * clock.rate_std:.2g} ppm (1σ; delays of the table's readings are not included)"
    )
    findings = (*made.findings, Finding("clock determined from the motion", message))
    return replace(made, findings=findings, provenance=provenance)


def _track(events: Sequence[Event], axis: str) -> AngleTrack:
    rows = {
        float(e.data["time_s"]): float(e.data["position_deg"])
        for e in events
        if e.name in ("angle", "track") and e.data["axis"] == axis and e.data["position_deg"] is not None
    }
    # Two entries of one time are one reading. Homing, which may reset the count, precedes all data.
    times, angles = np.array(sorted(rows.items())).reshape(-1, 2).T
    return AngleTrack(times, angles)


def _chamber(events: Sequence[Event], times_s: Floats, own_c: Floats) -> Floats:
    """The recording's temperatures, or else those of the chamber's load or air, °C."""
    chamber = [event for event in events if event.name == "chamber"]
    if not chamber or np.isfinite(own_c).any():
        return own_c
    loads = [event.data.get("product_c") for event in chamber]
    read_c = [float(e.data["air_c"] if load is None else load) for e, load in zip(chamber, loads, strict=True)]
    return np.interp(times_s, [event.time_s for event in chamber], read_c)


def _as_rows(recorded: Log, number: int, kind: np.dtype[Any]) -> Rows:
    """The samples of a recording as those of a run."""
    rows = np.zeros(len(recorded.time_s), kind)
    rows["time_s"] = recorded.time_s
    rows["rate"] = recorded.rate_rad_per_s[number]
    rows["force"] = rows["temperature_c"] = np.nan
    if recorded.force_axes == ("x", "y", "z") and recorded.specific_force_m_per_s2 is not None:
        rows["force"] = recorded.specific_force_m_per_s2[number]
    if recorded.temperature_c is not None:
        rows["temperature_c"] = recorded.temperature_c[number]
    rows["status"] = np.where(recorded.usable(number), 0, Reason.MARKED.value)
    steps = np.diff(recorded.time_s, prepend=recorded.time_s[0])
    rows["gap"] = np.maximum(np.round(steps / recorded.sample_interval_s).astype(np.int64) - 1, 0)
    return rows
