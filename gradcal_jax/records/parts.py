"""The rows of a run's log, part by part: which samples count, their clock, the table's motion."""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.hardware.roles import ImuDecoder
from gradcal_jax.records.clockmap import ClockMap, fit_arrivals
from gradcal_jax.records.counter_wraps import Doubt, resolve_wraps
from gradcal_jax.records.row_times import RowTimes
from gradcal_jax.records.sessions import Session
from gradcal_jax.records.spool import SampleSpool, Spool
from gradcal_jax.records.table_angles import MARGIN_S, SETTLED_S, RunAngles, standstills

_FEWEST_ARRIVALS: Final = 3
Floats = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """The rows of one session that count, on the session's clock; of several where the unit began anew in it."""

    session: Session
    rows: RowTimes
    clock: ClockMap
    table: RunAngles
    standing: tuple[tuple[int, int], ...]
    """First row of every standstill, and the row after its last one."""
    seen: "Seen"
    read: int
    doubts: tuple[tuple[float, Doubt], ...] = ()
    restarted: bool = False
    round_samples: int = 0
    bad_bytes: int = 0
    repeated: int = 0

    def standstill(self, first: int, count: int) -> Whole:
        """The numbers of the standstills, in this part, of rows; −1 while the table moves."""
        number = np.full(count, -1, np.int64)
        for place, (begin, end) in enumerate(self.standing):
            if begin < first + count and end > first:
                number[max(begin - first, 0) : end - first] = place
        return number


@dataclass
class Seen:
    """What a first pass over the rows that count has seen."""

    starts: list[int]
    """Rows before which samples are missing, or were not kept."""
    missing: int = 0
    gaps: int = 0
    marked: int = 0
    forces: bool = False
    second: bool = False
    """Whether there is a second thermometer."""
    mounted: bool = True
    """Whether the mounting of every row is known."""


def parts_of(session: Session, axes: Sequence[str]) -> tuple[list[Part], int]:
    """The parts of a session, and the number of samples in streams without a usable part."""
    stream = session.stream
    if stream is None or (decoder := stream.decoder) is None:
        return [], 0
    parts: list[Part] = []
    aside = 0
    for first, end in itertools.pairwise([stream.first, *stream.restarts, stream.end]):
        part = _part(session, stream.samples, decoder, first, end, axes)
        if part is None:
            aside += end - first
        else:
            parts.append(replace(part, restarted=first > stream.first))
    if parts:
        # The decoder counts for the whole session, and the counts of all parts are added.
        parts[0] = replace(parts[0], bad_bytes=decoder.bad_bytes, repeated=decoder.repeated_datagrams)
    return parts, aside


def _part(
    session: Session, samples: SampleSpool, decoder: ImuDecoder, first: int, end: int, axes: Sequence[str]
) -> Part | None:
    """The samples of a unit from its start on; None where there are none."""
    if not session.stretches():
        return None
    doubts = resolve_wraps(samples, first, end, decoder.round_samples, decoder.sample_s)
    with Spool([("device_s", np.float64), ("host_s", np.float64)], samples.folder) as arrivals:
        for _, block, last in samples.arrivals(first, end):
            arrivals.append(device_s=block["device_s"][last], host_s=block["host_s"][last])
        if len(arrivals) < _FEWEST_ARRIVALS:
            return None
        resolution_s = max(decoder.resolution_s, time.get_clock_info("monotonic").resolution)
        device, host = arrivals.column("device_s"), arrivals.column("host_s")
        clock = fit_arrivals(device, host, resolution_s=resolution_s)
    part = part_with_table(session, samples, first, end, clock, axes, decoder.sample_s)
    if part is None:
        return None
    begins_s = part.rows.host_s(0)
    at_s = [clock.host_time_s(samples.read(first + d.row, first + d.row + 1)["device_s"])[0] for d in doubts]
    placed = tuple((float(own_s - begins_s), doubt) for own_s, doubt in zip(at_s, doubts, strict=True))
    return replace(part, doubts=placed, round_samples=decoder.round_samples)


def part_with_table(
    session: Session,
    samples: SampleSpool,
    first: int,
    end: int,
    clock: ClockMap,
    axes: Sequence[str],
    sample_s: float,
) -> Part | None:
    """The samples in stretches with data, with the table's motion; None where there are none."""
    rows = _rows_that_count(session, samples, first, end, clock)
    if rows is None:
        return None
    # The stamps are as uncertain as the residuals of the clocks' line: a row may be earlier or later by that much.
    unsure_s = clock.residual_max_s
    runs: list[tuple[int, int]] = []
    for start, stop in standstills(session.events, axes):
        begin, over = start + SETTLED_S + sample_s + unsure_s, stop - MARGIN_S - unsure_s
        # Of a standstill that a pause cut short no row may be left.
        if (low := rows.search(begin)) < (high := rows.search(over)):
            runs.append((low, high))
    table = RunAngles(session.events, axes, rows, runs, sample_s + unsure_s)
    standing = tuple(run for place, run in enumerate(runs) if table.known_in(place))
    return Part(session, rows, clock, table, standing, _seen(session, rows), end - first)


def _rows_that_count(session: Session, samples: SampleSpool, first: int, end: int, clock: ClockMap) -> RowTimes | None:
    """The samples in stretches with data; None where there are fewer than two."""
    stretches = session.stretches()
    ranges: list[tuple[int, int]] = []
    for begin, block in samples.blocks(first, end):
        host = clock.host_time_s(block["device_s"])
        kept = np.zeros(len(host), bool)
        for start_s, end_s in stretches:
            kept |= (host > start_s) & (host <= end_s)
        for low, high in (formulas.runs(kept) + begin).tolist():
            joins = bool(ranges) and ranges[-1][1] == low
            ranges.append((ranges.pop()[0], high) if joins else (low, high))
    return RowTimes(samples, clock, ranges) if sum(high - low for low, high in ranges) > 1 else None


def _seen(session: Session, rows: RowTimes) -> Seen:
    seen = Seen(rows.seams())
    for first, host, block in rows.blocks():
        gaps = block["gap"]
        seen.starts += (first + np.flatnonzero(gaps > 0)).tolist()
        later = gaps[1:] if first == 0 else gaps
        seen.missing += int(np.maximum(later, 0).sum())
        seen.gaps += int(np.count_nonzero(later))
        seen.marked += int(np.count_nonzero(block["status"]))
        seen.forces = seen.forces or bool(np.isfinite(block["acceleration_g"]).any())
        seen.second = seen.second or bool(np.isfinite(block["second_c"]).any())
        seen.mounted = seen.mounted and bool(session.mountings(host).all())
    seen.starts = sorted(set(seen.starts))
    return seen


@dataclass(frozen=True)
class PlacedPart:
    """A part on the clocks of the log: what is added to the device's and to the computer's times, s, and to rows and
    the numbers of standstills."""

    part: Part
    device_s: float
    begins_s: float
    host_s: float
    first: int
    standing: int

    def stamps(self, device: Floats) -> Floats:
        return device - self.device_s + self.begins_s

    def blocks(self) -> Iterator[tuple[int, Floats, Floats, NDArray[Any]]]:
        """First row of the part, stamps, the computer's times on the part's own clock, samples."""
        for first, host, block in self.part.rows.blocks():
            yield first, self.stamps(block["device_s"]), host, block
