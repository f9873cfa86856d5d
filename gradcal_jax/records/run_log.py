"""From a run's journal to a log: samples decoded from the raw bytes, angles and standstills from the events.

Only rows of stretches with data are kept; all others are counted as removed. A pause ends stretches and standstills,
because the state of the rig in it is unknown. In a standstill all axes stand. Every poll of an axis's angle is one
reading, at the row at whose end the axis stands there.

The time stamp of a row is the sensor's clock, aligned with the computer's where data begin. `host_time` is the
computer's clock, by a straight line through the quickest arrivals, whose slope and residuals are in the log's
provenance. Where a run was resumed or an IMU restarted, the computer's clock gives the length of the interruption.

A log is made block by block from a spool on the disk, so that a run of days takes no more memory than one of an hour.
"""

import contextlib
import itertools
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.journal import Event, JournalContents, records_of
from gradcal_jax.hardware.roles import STANDARD_GRAVITY, ImuBatch, imu_batch
from gradcal_jax.hardware.run_folder import SESSION, RunFolder, exit_status, rig_as_run
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records.alignment import Alignment, AngleTrack, align
from gradcal_jax.records.clockmap import ClockMap
from gradcal_jax.records.log import SERIAL_NUMBER, AngleReadings, Finding, Log, Reason
from gradcal_jax.records.log_file import LogInBlocks
from gradcal_jax.records.parts import Part, PlacedPart, part_with_table, parts_of
from gradcal_jax.records.sessions import Session, sessions_of
from gradcal_jax.records.spool import SampleSpool
from gradcal_jax.records.table_angles import MOVE_COMMANDS, SETTLED_S
from gradcal_jax.spec.bench import RigTable
from gradcal_jax.spec.rig import ImuDevice, RigFile

# The length of an interruption that no clock measured.
_BETWEEN_SESSIONS_S: Final = 60.0
# A jump of the wall clock by less than this does not mean that the computer was off or asleep.
_CLOCK_SET_S: Final = 10.0
Floats = NDArray[np.float64]


def log(folder: str | Path, unit: str | None = None, *, recording: Log | None = None) -> Log:
    """The log of a run, decoded from its journal's raw bytes: rates in rad/s, times in s, temperatures in °C, the
    table's angles in rad, standstills.

    `unit`: the unit whose log is wanted, where the table carries several. `recording`: the unit's data in this run by
    another logger; its clock is aligned by the motion. Errors: `ValueError` where the folder is not a run's, or the
    recording is not of it; `HardwareError` where the journal holds no samples of a stretch with data.
    """
    with log_in_blocks(folder, unit, recording=recording) as found:
        return found.whole()


@contextlib.contextmanager
def log_in_blocks(
    folder: str | Path, unit: str | None = None, *, recording: Log | None = None, spool: Path | None = None
) -> Generator[LogInBlocks]:
    """As `log`, of a run whose samples do not fit into memory: they lie in a temporary file in the folder `spool` (of
    about the size of the log) until this context ends."""
    run = RunFolder(Path(folder))
    about = {name: str(text) for name, text in run.notes().get("about", {}).items()}
    with contextlib.ExitStack() as stack:
        if recording is not None:
            found = _of_recording(stack, spool, run.events(), run.recipe(), run.rig(), recording, unit)
        else:
            events = (one for one in records_of(run.journal_path) if isinstance(one, Event) and one.name == SESSION)
            first = JournalContents(list(itertools.islice(events, 1)))
            found = _of_unit(stack, spool, first, run.recipe(), run.rig(), unit, records_of(run.journal_path))
        provenance = {**about, **found.fields["provenance"]}
        yield replace(found, fields={**found.fields, "provenance": provenance})


def units_in(folder: str | Path) -> list[str | None]:
    """The names of the IMUs of a run that have logs; None where its only one needs no name."""
    names = [device.name for device in RunFolder(Path(folder)).rig().imu]
    return list(names) if len(names) > 1 else [None]


def _of_unit(
    stack: contextlib.ExitStack,
    spool: Path | None,
    contents: JournalContents,
    recipe: Recipe,
    rig: RigFile,
    unit: str | None,
    records: Any,
) -> LogInBlocks:
    """The log of a unit from all `records` of the journal; `contents` holds the begin of the first session at least."""
    rig = rig_as_run(contents, rig)
    device = _device(rig, unit)
    sessions = sessions_of(records, device, stack.enter_context(SampleSpool(folder=spool)))
    names = [axis.name for axis in rig.axis]
    # The axes of the spec, in that order; a single axis may have another name.
    drawn = [axis.name for axis in recipe.spec.rig.table.axis]
    axes = _axes_of(sessions, drawn if set(drawn) <= set(names) else names)
    found = [parts_of(session, axes) for session in sessions]
    parts, aside = [part for kept, _ in found for part in kept], sum(left for _, left in found)
    if not parts:
        raise HardwareError(
            "The journal has no samples to use: the run ended before the first part whose data are used."
        )
    provenance = _provenance(parts, sessions, recipe, (device.name, device.driver))
    events = (event for session in sessions for event in session.events)
    identities = (e.data for e in events if e.name == "identity" and e.data["device"] == device.name)
    if number := next((str(of["serial_number"]) for of in identities if of.get("serial_number")), ""):
        provenance[SERIAL_NUMBER] = number
    return _joined(parts, _labels(axes, recipe, rig), device.serial_number or device.name, provenance, aside)


def _of_recording(
    stack: contextlib.ExitStack,
    spool: Path | None,
    contents: JournalContents,
    recipe: Recipe,
    rig: RigFile,
    recorded: Log,
    unit: str | None,
) -> LogInBlocks:
    """The log of a unit that another logger recorded, with the run's table and chamber.

    Each part of the run is aligned with the recording by the motion (`alignment`). Temperatures are the recording's,
    or else the chamber's. Raises `HardwareError` where the run has no stretch with data, `NoAlignment` (a `ValueError`)
    where the recording does not show the run's motion.
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
    parts: list[Part] = []
    alignments: list[Alignment] = []
    samples = stack.enter_context(SampleSpool(len(rates), spool))
    for session in sessions:
        if session.stretches():
            tracks = {label: _track(session.events, axis) for axis, label in zip(axes, labels, strict=True)}
            alignments.append(align(recorded.time_s, turned, tracks))
            first = len(samples)
            samples.push(_as_samples(recorded, number, rates, alignments[-1], session.events))
            clock, every_s = _clock_of(alignments[-1]), recorded.sample_interval_s
            part = part_with_table(session, samples, first, len(samples), clock, axes, every_s)
            parts += [] if part is None else [part]
    if not parts:
        raise HardwareError("The recording has no samples from any part of the run whose data are used.")
    who = recorded.units[number]
    provenance = _provenance(parts, sessions, recipe, (who, "recorded elsewhere"))
    provenance["clock_offset_std_s"] = ", ".join(f"{one.offset_std_s:.1e}" for one in alignments)
    log = _joined(parts, labels, who, provenance, 0, tuple(rates))
    message = "; ".join(
        f"the recording's clock was determined from {one.readings} readings of {one.bursts} turns, to "
        f"{one.offset_std_s:.2g} s and {1e6 * one.rate_std:.2g} ppm (1σ; delays of the table's readings are not "
        "included)"
        for one in alignments
    )
    findings = (*log.fields["findings"], Finding("clock determined from the motion", "keep", 0, message))
    return replace(log, fields={**log.fields, "findings": findings})


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
    forces = np.full((count, 3), np.nan)
    if recorded.force_axes == ("x", "y", "z") and recorded.specific_force_m_per_s2 is not None:
        forces = recorded.specific_force_m_per_s2[number] / STANDARD_GRAVITY
    more = {"gap_before": missing, "second_c": recorded.bridged_temperature(number, second=True)}
    if recorded.status is not None:
        more["status"] = recorded.status[number].astype(np.int64)
    gyro, temperatures = np.stack(list(rates.values()), axis=-1), np.repeat(temperature[:, None], 3, axis=1)
    known = {name: values for name, values in more.items() if values is not None}
    return replace(imu_batch(0.0, recorded.time_s, gyro, forces, temperatures, **known), host_time_s=host)


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


# ------------------------------------------------------------------------------------------------------------ joined


def _joined(
    parts: Sequence[Part],
    labels: tuple[str, ...],
    unit: str,
    provenance: dict[str, str],
    aside: int,
    axes: tuple[str, ...] = ("x", "y", "z"),
) -> LogInBlocks:
    placed = _placed(parts)
    starts: list[int] = []
    readings: list[AngleReadings] = []
    for one in placed:
        part = one.part
        starts += sorted({one.first, *(one.first + start for start in part.seen.starts)})
        # The reading's time by the rows' two clocks, which differ by less than a part in a thousand.
        own = part.table.readings
        at = own.row.tolist()
        since = own.time_s - np.array([part.rows.host_s(row) for row in at])
        stamps = one.stamps(np.array([part.rows.device_s(row) for row in at]))
        readings.append(replace(own, time_s=stamps + since, row=own.row + one.first))
    rows = placed[-1].first + len(parts[-1].rows)
    read = aside + sum(part.read for part in parts)
    forced, doubly = (any(getattr(part.seen, what) for part in parts) for what in ("forces", "second"))
    fields: dict[str, Any] = {
        "units": (unit,),
        "axes": axes,
        "force_axes": ("x", "y", "z") if forced else (),
        "table_axes": labels,
        "readings": AngleReadings.in_order(readings) if labels else None,
        "stretch_starts": np.array(starts, np.int64),
        "rows_read": read,
        "rows_removed": {"not in a stretch of data": read - rows} if read > rows else {},
        "findings": _findings(parts),
        "simulated": any(part.session.simulated for part in parts),
        "provenance": provenance,
    }
    last = placed[-1]
    ends_s = float(last.stamps(np.array([last.part.rows.device_s(len(last.part.rows) - 1)]))[0])
    return LogInBlocks(
        rows,
        fields,
        lambda: _blocks(placed, forced, doubly),
        duration_s=ends_s - placed[0].begins_s,
        standstills=last.standing + len(last.part.standing),
        masked=sum(part.seen.marked for part in parts),
    )


def _blocks(placed: Sequence[PlacedPart], forced: bool, doubly: bool) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    spins = all(one.part.table.spins for one in placed)
    mounted = all(one.part.seen.mounted for one in placed)
    for one in placed:
        part = one.part
        for first, stamps, host, block in one.blocks():
            standing = part.standstill(first, len(host))
            columns: dict[str, NDArray[Any]] = {
                "time_s": stamps,
                "host_time_s": host + one.host_s,
                "rate_rad_per_s": np.radians(block["gyro_dps"])[None],
                "temperature_c": np.ascontiguousarray(block["temperature_c"])[None],
                "standstill": np.where(standing >= 0, standing + one.standing, -1),
                "status": np.where(block["status"] != 0, np.uint16(Reason.MARKED.value), np.uint16(0))[None],
            }
            if forced:
                columns["specific_force_m_per_s2"] = (block["acceleration_g"] * STANDARD_GRAVITY)[None]
            if doubly:
                columns["second_temperature_c"] = np.ascontiguousarray(block["second_c"])[None]
            if spins:
                columns["table_rate_rad_per_s"] = np.radians(part.table.rates_dps(host))
            if mounted:
                columns["mounting"] = part.session.mountings(host) - 1
            yield one.first + first, columns


def _placed(parts: Sequence[Part]) -> list[PlacedPart]:
    """All parts on the clocks of the first.

    The computer's clock continues in the next session, unless the computer was restarted or slept in between: the wall
    clock then gives the difference. The log's clock is the sensor's; the computer's gives the begin of the first part
    and the distance between two parts.
    """
    first = parts[0]
    placed = [PlacedPart(first, first.rows.device_s(0), first.rows.host_s(0), 0.0, 0, 0)]
    shift_s = 0.0
    for before, part in itertools.pairwise(parts):
        last = len(before.rows) - 1
        end_s = before.rows.host_s(last) + placed[-1].host_s
        stood_s = part.session.origin_s - before.session.origin_s
        # Simulated devices run on their own clock, which is independent of the wall clock.
        if stood_s > _CLOCK_SET_S and not part.session.simulated:
            shift_s += stood_s
        apart_s = part.rows.host_s(0) + shift_s - end_s
        device_s = part.rows.device_s(0)
        if apart_s <= 0.0:
            again = part.session is before.session
            least_s = part.rows.device_s(1) - device_s if again else _BETWEEN_SESSIONS_S
            shift_s += least_s - apart_s
        ended_s = float(placed[-1].stamps(np.array([before.rows.device_s(last)]))[0])
        begins_s = ended_s + (part.rows.host_s(0) + shift_s) - end_s
        row, standing = placed[-1].first + last + 1, placed[-1].standing + len(before.standing)
        placed.append(PlacedPart(part, device_s, begins_s, shift_s, row, standing))
    return placed


_UNKNOWN = "samples are missing, nobody can tell how many, and the log continues by the computer's clock,"
_REFUSED = "attempts at a step that the run itself did not accept are left out: see the journal for the reasons"


def _findings(parts: Sequence[Part]) -> tuple[Finding, ...]:
    missing, gaps = (sum(getattr(part.seen, name) for part in parts) for name in ("missing", "gaps"))
    unsure = max(part.clock.residual_max_s for part in parts)
    anew = sum(part.restarted for part in parts)
    unknown = sum(part.after_gap for part in parts)
    refused = sum({id(part.session): part.session.refused() for part in parts}.values())
    bad, twice = (sum(getattr(part, name) for part in parts) for name in ("bad_bytes", "repeated"))
    lateness = (
        f"the computer was so busy that its time stamps are accurate only to {unsure:.2g} s: as an additional "
        "margin, this time is left out"
    )
    times = f"{anew} time{'s' * (anew > 1)} during the run; the samples lost in a restart are not counted as missing"
    gap = [Finding("gap", "split", gaps, f"{missing} samples are missing at {gaps} places")] if missing else []
    others = [
        (unsure > SETTLED_S, Finding("late stamps", "mask", 0, f"{lateness} at both ends of every standstill")),
        (unknown, Finding("gap of unknown length", "split", unknown, f"{_UNKNOWN} at {unknown} places")),
        (anew, Finding("unit restarted", "split", anew, f"the IMU restarted {times}")),
        (bad, Finding("unreadable bytes", "keep", 0, f"{bad} bytes belong to no valid datagram")),
        (refused, Finding("refused attempt", "mask", refused, _REFUSED)),
        (twice, Finding("repeated datagram", "keep", 0, f"{twice} datagrams arrived twice; each is used once")),
    ]
    return (*gap, *(one for there, one in others if there))


def _provenance(
    parts: Sequence[Part], sessions: Sequence[Session], recipe: Recipe, unit: tuple[str, str]
) -> dict[str, str]:
    first_rows = itertools.accumulate((len(part.rows) for part in parts[:-1]), initial=0)
    entries: dict[str, Any] = {
        "recipe": recipe.fingerprint,
        "title": recipe.title or "",
        "run": exit_status(JournalContents([event for session in sessions for event in session.events])),
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
