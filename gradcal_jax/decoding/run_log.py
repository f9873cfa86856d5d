"""From a run's journal to a log: samples decoded from the raw bytes, angles and standstills from the events.

Only rows of stretches with data are kept: soaks, waiting and what a run did before a stretch began are counted as
removed. So is a pause: nobody knows what became of the rig in it, and it ends stretches and standstills. A standstill
is of all axes; a row of one carries the readings of the table's angles that are nearest to it in time. While other axes
move, one that stands carries its own nearest reading, and one that a motor turns goes by the trapezoid that it was
told, between what was read before and after; every other angle is drawn straight between readings, good for a look and
not for estimation.

The stamps of a row are the sensor's own clock, laid on the computer's where data begin; `host_time` is the computer's,
by a straight line through the quickest arrivals, whose slope and residuals are in the log's provenance. Where a run was
resumed, or a unit began anew, the computer tells how much later its clock goes on.
"""

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..files.log import Finding, Log, Reason
from ..files.recipe import Recipe
from ..files.rig import ImuDevice, RigFile
from ..files.unit_spec import UnitSpec
from ..hardware.drivers.imu_common import STANDARD_GRAVITY, join
from ..hardware.errors import HardwareError
from ..hardware.journal import Chunk, Event, JournalContents
from ..hardware.roles import ImuBatch, ImuDecoder
from ..hardware.run_folder import SESSION, RunFolder, exit_status, rig_as_run
from ..hardware.setup import config_of, driver_of
from ..hardware.stretches import breaks_off
from ..hardware.track import AxisCommand
from .alignment import Alignment, AngleTrack, align
from .clockmap import ClockMap, fit_clock
from .counter_wraps import Doubt, wraps_resolved

_MARGIN_S: Final = 0.02
# Stamps of samples are late by what unit, adapter and system take, nobody knows how much; a row too few at rest costs
# nothing, and one that still turned would be taken for rest.
_SETTLED_S: Final = 0.1
# Taken where no clock tells how much later a run went on.
_BETWEEN_SESSIONS_S: Final = 60.0
# A wall clock that was set by less than this is no sign that the computer was off or asleep.
_CLOCK_SET_S: Final = 10.0
_FEWEST_ARRIVALS: Final = 3
# A motor whose move lasts so much longer than its trapezoid did not follow it.
_LATE_S: Final = 0.2
Floats = NDArray[np.float64]


@dataclass
class _Session:
    """One part of a run: its records in order. It began at `begun_s` of the run's clock, the units hanging as the
    `mounting` of that number, from 1; 0: nobody was ever asked to hang them."""

    number: int
    simulated: bool
    wall_clock_s: float
    begun_s: float
    mounting: int
    events: list[Event] = field(default_factory=list[Event])
    chunks: dict[str, list[Chunk]] = field(default_factory=dict[str, list[Chunk]])

    @property
    def origin_s(self) -> float:
        """When the run's clock stood at zero, by the clock on the wall."""
        return self.wall_clock_s - self.begun_s


def log(folder: str | Path, unit: str | None = None, *, recording: Log | None = None) -> Log:
    """The log of a run, decoded from its journal's raw bytes: rates in rad/s, times in s, temperatures in °C, the
    table's angles in rad, standstills.

    `unit`: of several units on the table, the one whose log to make. `recording`: what somebody else's logger recorded
    of the unit in this run; its clock is found by the motion. Errors: `ValueError` where the folder is not a run's, or
    the recording is not of it; `HardwareError` where the journal holds no samples of a stretch with data.
    """
    found = RunFolder(Path(folder))
    about = {name: str(text) for name, text in found.notes().get("about", {}).items()}
    if recording is not None:
        made = log_of_recording(found.contents(), found.recipe(), found.rig(), recording, unit)
    else:
        made = log_of(found.contents(), found.recipe(), found.rig(), unit)
    return replace(made, provenance={**about, **made.provenance})


def log_of(contents: JournalContents, recipe: Recipe, rig: RigFile, unit: str | None = None) -> Log:
    """The log of one unit (by name; None: the rig's only one), decoded as the journal says that it was configured.

    Raises `HardwareError` where the journal holds no samples of a stretch with data.
    """
    rig = rig_as_run(contents, rig)
    device = _device(rig, unit)
    parts: list[_Part] = []
    aside = 0
    found = _sessions(contents)
    names = [axis.name for axis in rig.axis]
    if isinstance(recipe.spec, UnitSpec):
        # The table of a whole unit has the axes of its spec, in that order; a single one may be named otherwise.
        drawn = [axis.name for axis in recipe.spec.rig.table.axis]
        names = drawn if set(drawn) <= set(names) else names
    axes = _axes_of(found, names)
    for session in found:
        kept, left = _parts(session, device, axes)
        parts += kept
        aside += left
    if not parts:
        raise HardwareError(
            "The journal holds no samples of a stretch with data: the run ended before its first stretch began."
        )
    provenance = _provenance(parts, found, recipe, (device.name, device.driver), exit_status(contents))
    return _joined(parts, _labels(axes, recipe, rig), device.serial_number or device.name, provenance, aside)


def log_of_recording(contents: JournalContents, recipe: Recipe, rig: RigFile, recorded: Log, unit: str | None) -> Log:
    """The log of a unit that somebody else recorded, with the run's table and chamber.

    Each part of the run is laid on the recording by the motion (`alignment`). Temperatures are the recording's own, or
    else the chamber's. Raises `HardwareError` where the run has no stretch with data, `NoAlignment` (a `ValueError`)
    where the recording does not show the run's motion.
    """
    rig = rig_as_run(contents, rig)
    number = recorded.unit_index(unit or 0)
    found = _sessions(contents)
    axes = _axes_of(found, [axis.name for axis in rig.axis])
    labels = _labels(axes, recipe, rig)
    rates = {axis: np.degrees(recorded.rate_rad_per_s[number, :, k]) for k, axis in enumerate(recorded.axes)}
    if len(labels) == len(rates) == 1:
        # Each has one axis only, whatever it is called.
        rates = dict(zip(labels, rates.values(), strict=True))
    parts: list[_Part] = []
    laid: list[Alignment] = []
    for session in found:
        if _stretches(session.events):
            tracks = {label: _track(session.events, axis) for axis, label in zip(axes, labels, strict=True)}
            laid.append(align(recorded.time_s, rates, tracks))
            samples = _as_samples(recorded, number, rates, laid[-1], session.events)
            part = _laid(session, samples, _clock_of(laid[-1]), axes, recorded.sample_interval_s)
            parts += [] if part is None else [part]
    if not parts:
        raise HardwareError("The recording holds no samples of a stretch of the run with data.")
    who = recorded.units[number]
    provenance = _provenance(parts, found, recipe, (who, "recorded elsewhere"), exit_status(contents))
    provenance["clock_offset_std_s"] = ", ".join(f"{one.offset_std_s:.1e}" for one in laid)
    log = _joined(parts, labels, who, provenance, 0, tuple(rates))
    message = "; ".join(
        f"the recording's clock is known by {one.readings} readings of {one.bursts} turns to {one.offset_std_s:.2g} s "
        f"and {1e6 * one.rate_std:.2g} ppm (1σ), delays of the table's readings not reckoned"
        for one in laid
    )
    return replace(log, findings=(*log.findings, Finding("clock found by the motion", "keep", 0, message)))


def _track(events: Sequence[Event], axis: str) -> AngleTrack:
    """Everything that was read of an axis's angle, in order."""
    rows = [
        (float(e.data["time_s"]), float(e.data["position_deg"]))
        for e in events
        if e.name in ("angle", "track") and e.data["axis"] == axis and e.data["position_deg"] is not None
    ]
    times, angles = np.array(sorted(rows)).reshape(-1, 2).T
    # What stands twice in the journal was read once; homing, which may count anew, is before all data.
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


def _clock_of(found: Alignment) -> ClockMap:
    """As the line of a stream's clock: rows at both ends of a rest are left away by five sigmas."""
    offset_s = found.offset_s - found.rate * found.middle_s
    std_s = found.offset_std_s
    return ClockMap(offset_s, found.rate, found.rate_std, std_s, 5.0 * std_s, found.readings, 0)


def _device(rig: RigFile, unit: str | None) -> ImuDevice:
    names = [device.name for device in rig.imu]
    if unit is None and len(names) == 1:
        return rig.imu[0]
    if unit not in names:
        raise HardwareError(f"Which unit? The run has {', '.join(names) or 'none'}.")
    return rig.imu[names.index(unit)]


def _sessions(contents: JournalContents) -> list[_Session]:
    found: list[_Session] = []
    mounting = 0
    for record in contents.records:
        if isinstance(record, Event):
            if record.name == SESSION:
                data = record.data
                wall_clock_s, simulated = float(data["wall_clock_s"]), bool(data["simulated"])
                found.append(_Session(int(data["number"]), simulated, wall_clock_s, record.time_s, mounting))
            elif record.name == "hung":
                mounting = int(record.data["mounting"])
            if found:
                found[-1].events.append(record)
        elif found and record.received:
            found[-1].chunks.setdefault(record.line, []).append(record)
    return found


def _axes_of(found: Sequence[_Session], names: Sequence[str]) -> list[str]:
    """The rig's axes that were ever told to move or gave a reading: of what nobody turns or reads nothing is known, and
    nothing depends on it."""
    heard = {str(e.data["axis"]) for session in found for e in session.events if e.name in ("angle", *_TOLD_TO_MOVE)}
    return [name for name in names if name in heard]


def _labels(axes: Sequence[str], recipe: Recipe, rig: RigFile) -> tuple[str, ...]:
    """The axes' names in the log: the rig's, but the recipe's where each has one axis only, whatever their names."""
    turned = {move.axis for block in recipe.motion for move in block.moves if move.do not in ("rest", "wait")}
    return tuple(turned) if len(axes) == len(rig.axis) == len(turned) == 1 else tuple(axes)


# ------------------------------------------------------------------------------------------------------ one session

# Not "stopped": what stood stands on, and what moved was told to.
_TOLD_TO_MOVE: Final = ("move", "homing")


@dataclass
class _Part:
    """The rows of one session that count, on the session's clock; of several where the unit began anew in it."""

    session: _Session
    samples: ImuBatch
    device_s: Floats
    host_s: Floats
    clock: ClockMap
    angles_deg: Floats
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


def _parts(session: _Session, device: ImuDevice, axes: Sequence[str]) -> tuple[list[_Part], int]:
    """What a session gave, and the number of the samples of what ended before it gave anything."""
    decoder = _decoder(session, device)
    chunks = session.chunks.get(device.name, [])
    if decoder is None or not chunks:
        return [], 0
    samples = join([decoder.push(chunk.data, chunk.time_s) for chunk in chunks])
    found: list[_Part] = []
    aside = 0
    starts = np.flatnonzero(samples.restarted[1:]) + 1
    for rows in np.split(np.arange(len(samples)), starts):
        part = _part(session, decoder, _taken(samples, rows), axes)
        if part is None:
            aside += len(rows)
        else:
            found.append(replace(part, restarted=bool(rows[0])))
    if found:
        # The decoder counts for the session, and every sum is taken over all parts.
        found[0] = replace(found[0], bad_bytes=decoder.bad_bytes, repeated=decoder.repeated_datagrams)
    return found, aside


def _part(session: _Session, decoder: ImuDecoder, samples: ImuBatch, axes: Sequence[str]) -> _Part | None:
    """What a unit gave from its start on; None where that is nothing."""
    if not _stretches(session.events) or len(np.unique(samples.host_time_s)) < _FEWEST_ARRIVALS:
        return None
    samples, doubts = wraps_resolved(samples, decoder.round_samples, decoder.sample_s)
    resolution_s = max(decoder.resolution_s, time.get_clock_info("monotonic").resolution)
    clock = fit_clock(samples.device_time_s, samples.host_time_s, resolution_s=resolution_s)
    part = _laid(session, samples, clock, axes, decoder.sample_s)
    if part is None:
        return None
    after_s = clock.host_time_s(samples.device_time_s) - float(part.host_s[0])
    placed = tuple((float(after_s[doubt.row]), doubt) for doubt in doubts)
    return replace(part, doubts=placed, round_samples=decoder.round_samples)


def _laid(session: _Session, samples: ImuBatch, clock: ClockMap, axes: Sequence[str], sample_s: float) -> _Part | None:
    """The samples in stretches with data, with what the table did; None where there are none."""
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
    standing = _standstills(session.events, axes)
    number = np.full(len(rows), -1, np.int64)
    # The line of the clocks is as sure as the arrivals that it was laid through agree: a row may be earlier or later by
    # that much.
    unsure_s = clock.residual_max_s
    for place, (start, end) in enumerate(standing):
        begun, over = start + _SETTLED_S + sample_s + unsure_s, end - _MARGIN_S - unsure_s
        first, last = np.searchsorted(at_s, [begun, over])
        number[first : max(first, last)] = place
    angles = (
        np.stack([_angles(session.events, axis, at_s, number) for axis in axes], axis=-1)
        if axes
        else np.zeros((len(rows), 0))
    )
    number[~np.isfinite(angles).all(axis=-1)] = -1
    # Numbered anew: of a standstill that a pause cut short no row may be left.
    left = np.unique(number[number >= 0])
    number[number >= 0] = np.searchsorted(left, number[number >= 0])
    return _Part(
        session,
        _taken(samples, rows),
        samples.device_time_s[rows],
        at_s,
        clock,
        angles,
        number,
        _mountings(session, at_s),
        [int(start) for start in starts],
        len(samples),
        int(np.maximum(missing[1:], 0).sum()),
    )


def _taken(samples: ImuBatch, rows: NDArray[np.int64]) -> ImuBatch:
    return ImuBatch(**{name: getattr(samples, name)[rows] for name in ImuBatch.__dataclass_fields__})


def _decoder(session: _Session, device: ImuDevice) -> ImuDecoder | None:
    """A fresh decoder, from what the unit said of itself when it was configured."""
    said = next((e for e in session.events if e.name == "configuration" and e.data["device"] == device.name), None)
    if said is None:
        return None
    config = config_of(device, "imu", ("imu", device.name))
    driver = driver_of(device.driver)
    assert driver is not None
    return driver.load().decoder_of(config, said.data["registers"])


def _stretches(events: Sequence[Event]) -> list[tuple[float, float]]:
    """From where a step with data begins to where it ends, the run breaks off, or the session does."""
    found: list[tuple[float, float]] = []
    open_since: float | None = None
    latest = 0.0
    for event in events:
        latest = max(latest, event.time_s)
        if event.name == "step begins" and event.data.get("data"):
            begin = float(event.data["begins_s"])
            if open_since is None:
                open_since = begin
        elif open_since is not None and (event.name == "step" or breaks_off(event)):
            # A step that follows at once goes on with the stretch: its "step begins" comes at the same instant.
            found.append((open_since, event.time_s))
            open_since = None
    if open_since is not None:
        found.append((open_since, latest))
    merged: list[tuple[float, float]] = []
    for start, end in found:
        joins = bool(merged) and start - merged[-1][1] < 1e-3
        merged.append((merged.pop()[0], end) if joins else (start, end))
    return merged


def _standstills(events: Sequence[Event], axes: Sequence[str]) -> list[tuple[float, float]]:
    """When no axis moves: from the reading that says so to the next command of motion, or until the run breaks off.

    What stood then stands again from where the next step begins: an angle that somebody typed is not read again.
    """
    moving = set(axes)
    found: list[tuple[float, float]] = []
    since: float | None = None
    latest = 0.0
    for event in events:
        latest = max(latest, event.time_s)
        if event.name == "angle" and not event.data["moving"] and event.data["axis"] in moving:
            moving.discard(str(event.data["axis"]))
            if not moving:
                since = float(event.data["time_s"])
        elif event.name == "step begins" and since is None and axes and not moving:
            since = float(event.data["begins_s"])
        elif event.name in _TOLD_TO_MOVE or breaks_off(event):
            if since is not None:
                found.append((since, float(event.data.get("began_s", event.time_s))))
                since = None
            if event.name in _TOLD_TO_MOVE:
                moving.add(str(event.data["axis"]))
    if since is not None:
        found.append((since, latest))
    return [(start, end) for start, end in found if end > start]


def _mountings(session: _Session, host: Floats) -> NDArray[np.int64]:
    """Of every row the number of the mounting, from 1; 0 where nobody was ever asked to hang the units."""
    hung = [(event.time_s, int(event.data["mounting"])) for event in session.events if event.name == "hung"]
    numbers = np.array([session.mounting, *(number for _, number in hung)], np.int64)
    return numbers[np.searchsorted(np.array([time for time, _ in hung]), host, side="right")]


def _angles(events: Sequence[Event], axis: str, host: Floats, standstill: NDArray[np.int64]) -> Floats:
    """The axis's angle at every row, deg: of a standstill the nearest reading since the axis was last told to move (an
    angle that somebody typed holds until it is turned again), else what is known of its own moves.
    """
    readings = [
        e for e in events if e.name == "angle" and e.data["axis"] == axis and e.data["position_deg"] is not None
    ]
    if not readings:
        return np.full(len(host), np.nan)
    times = np.array([float(e.data["time_s"]) for e in readings])
    values = np.array([float(e.data["position_deg"]) for e in readings])
    still = np.array([not e.data["moving"] for e in readings])
    told_to_move = [e for e in events if e.name in _TOLD_TO_MOVE and e.data["axis"] == axis]
    moved = np.array([float(e.data.get("began_s", e.time_s)) for e in told_to_move])
    result = _own_course(np.interp(host, times, values), host, told_to_move, moved, times[still], values[still])
    edges = np.flatnonzero(np.diff(standstill, prepend=-1, append=-1))
    for begin, end in itertools.pairwise(edges):
        if begin >= len(standstill) or standstill[begin] < 0:
            continue
        told = int(np.searchsorted(moved, float(host[begin])))
        low, high = moved[told - 1] if told else -math.inf, host[end - 1] + 2.0 * _MARGIN_S
        inside = np.flatnonzero(still & (times >= low) & (times <= high))
        if not len(inside):
            result[begin:end] = np.nan
            continue
        near = np.searchsorted((times[inside][1:] + times[inside][:-1]) / 2.0, host[begin:end])
        result[begin:end] = values[inside][near]
    return result


def _own_course(
    straight: Floats, host: Floats, told: Sequence[Event], moved: Floats, times: Floats, values: Floats
) -> Floats:
    """An axis's angle at every row, deg, whatever others do: nearest of its readings `values` at `times` while it
    stands, and the trapezoid that it was told from one to the next; `straight` where neither is known."""
    result = straight.copy()
    for k in range(-1, len(told)):
        begin = moved[k] if k >= 0 else -math.inf
        until = moved[k + 1] if k + 1 < len(told) else math.inf
        # A reading at the very instant of a command is of the standstill before it.
        first, last = np.searchsorted(times, np.array([begin, until]), side="right")
        if first == last:
            continue
        low, middle, high = np.searchsorted(host, np.array([begin, float(times[first]), until]))
        own = times[first:last]
        result[middle:high] = values[first:last][np.searchsorted((own[1:] + own[:-1]) / 2.0, host[middle:high])]
        move = told[k].data if k >= 0 else {}
        if first == 0 or move.get("kind") not in ("go", "turn") or not move.get("acceleration_dps2"):
            continue
        angle, rate = float(values[first] - values[first - 1]), float(move["rate_dps"])
        turn = AxisCommand(0.0, "", "turn", rate_dps=rate, acceleration_dps2=move["acceleration_dps2"], angle_deg=angle)
        # A person, or a stage that was held up, is not done when the trapezoid is.
        if turn.duration_s + _LATE_S > times[first] - begin:
            result[low:middle] = values[first - 1] + _turned(turn, host[low:middle] - begin)
    return result


def _turned(turn: AxisCommand, since: Floats) -> Floats:
    """How far a turn has come (deg), seconds after it began."""
    size, whole = abs(turn.angle_deg), turn.duration_s
    if whole == 0.0:
        return np.full(len(since), turn.angle_deg)
    peak = min(abs(turn.rate_dps), math.sqrt(size * turn.acceleration_dps2))
    ramp = peak / turn.acceleration_dps2
    near = 0.5 * turn.acceleration_dps2 * np.clip(np.minimum(since, whole - since), 0.0, ramp) ** 2
    sides = np.where(since < 0.5 * whole, near, size - near)
    flat = (since > ramp) & (since < whole - ramp)
    return math.copysign(1.0, turn.angle_deg) * np.where(flat, peak * (since - 0.5 * ramp), sides)


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
    row, numbered = 0, 0
    hosts = _on_one_clock(parts)
    for place, (part, host) in enumerate(zip(parts, hosts, strict=True)):
        # The sensor's own seconds: the computer's tell where the first part begins, and how far apart two parts are.
        begins_s = float(times[-1][-1] + host[0] - hosts[place - 1][-1]) if place else float(host[0])
        times.append(part.device_s - part.device_s[0] + begins_s)
        standstills.append(np.where(part.standstill >= 0, part.standstill + numbered, -1))
        numbered += int(part.standstill.max(initial=-1)) + 1
        starts += sorted({row, *(row + start for start in part.starts)})
        row += len(host)
    samples = join([part.samples for part in parts])
    marked = np.where(samples.status != 0, np.uint16(Reason.MARKED.value), np.uint16(0)).astype(np.uint16)
    read = aside + sum(part.read for part in parts)
    force = samples.acceleration_g * STANDARD_GRAVITY
    mounting = np.concatenate([part.mounting for part in parts])
    return Log(
        time_s=np.concatenate(times),
        rate_rad_per_s=np.radians(samples.gyro_dps)[None],
        units=(unit,),
        axes=axes,
        specific_force_m_per_s2=force[None] if np.isfinite(force).any() else None,
        force_axes=("x", "y", "z") if np.isfinite(force).any() else (),
        temperature_c=samples.temperature_c.mean(axis=1)[None],
        table_axes=labels,
        table_angle_rad=np.radians(np.concatenate([part.angles_deg for part in parts])) if labels else None,
        standstill=np.concatenate(standstills),
        mounting=mounting - 1 if mounting.all() else None,
        host_time_s=np.concatenate(hosts),
        status=marked[None],
        stretch_starts=np.array(starts, np.int64),
        rows_read=read,
        rows_removed={"not in a stretch of data": read - row} if read > row else {},
        findings=_findings(parts),
        simulated=any(part.session.simulated for part in parts),
        provenance=provenance,
    )


def _on_one_clock(parts: Sequence[_Part]) -> list[Floats]:
    """The computer's times of all rows, on the clock of the first session.

    That clock goes on in the next session, unless the computer was switched on anew or slept in between: then the clock
    on the wall went on without it, and tells by how much.
    """
    hosts = [parts[0].host_s]
    shift_s = 0.0
    for before, part in itertools.pairwise(parts):
        end_s = float(hosts[-1][-1])
        stood_s = part.session.origin_s - before.session.origin_s
        # Simulated devices run on a clock of their own, which has nothing to do with the one on the wall.
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
        (unsure > _SETTLED_S, Finding("late stamps", "mask", 0, f"{lateness} at both ends of every standstill")),
        (anew, Finding("unit restarted", "split", anew, f"the unit began anew {times}")),
        (bad, Finding("unreadable bytes", "keep", 0, f"{bad} bytes belong to no sound datagram")),
        (twice, Finding("repeated datagram", "keep", 0, f"{twice} datagrams came twice and count once")),
    ]
    found = [Finding("gap", "split", gaps, f"{missing} samples are missing in {gaps} places")] if missing else []
    found += _findings_of_rounds(parts)
    return (*found, *(one for there, one in others if there))


def _findings_of_rounds(parts: Sequence[_Part]) -> list[Finding]:
    """Where it is not certain how many samples are missing: each kind with the first place of it."""
    found: list[Finding] = []
    for traced, kind in ((True, "gap of doubtful length"), (False, "stamps that come later")):
        places = [(part, *said) for part in parts for said in part.doubts if said[1].traced == traced]
        if places:
            part, first_s, first = places[0]
            samples = part.round_samples
            message = (
                f"{len(places)} of the gaps may be longer or shorter by a round of the counter ({samples} samples)"
                if traced
                else f"in {len(places)} places {samples} samples or a multiple of it may be missing; none are counted"
            )
            where = f"the first {abs(first_s):.1f} s {'before' if first_s < 0.0 else 'after'} data begin: {first.why}"
            found.append(Finding(kind, "split" if traced else "keep", len(places), f"{message}; {where}"))
    return found


def _provenance(
    parts: Sequence[_Part], sessions: Sequence[_Session], recipe: Recipe, unit: tuple[str, str], status: str
) -> dict[str, str]:
    first_rows = itertools.accumulate((len(part.host_s) for part in parts[:-1]), initial=0)
    said: dict[str, Any] = {
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
    return {name: str(value) for name, value in said.items()}
