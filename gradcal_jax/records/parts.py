"""The rows of a run's log, part by part: which samples count, their clock, the table's motion."""

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.hardware.roles import ImuDecoder
from gradcal_jax.records.clockmap import ClockMap, fit_arrivals
from gradcal_jax.records.row_times import RowTimes
from gradcal_jax.records.sessions import Session
from gradcal_jax.records.spool import SampleSpool, Spool
from gradcal_jax.records.table_angles import MARGIN_S, SETTLED_S, RunAngles, standstills

_FEWEST_ARRIVALS: Final = 3
_WINDOW_S: Final = 60.0
"""Before and after a gap, in which the quickest arrivals are compared."""
_SURE: Final = 0.25
"""Of a counter period."""
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
    restarted: bool = False
    after_gap: bool = False
    """Whether nobody knows how many samples are missing before it."""
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
    for begin, stop in itertools.pairwise([stream.first, *stream.restarts, stream.end]):
        unknown = count_rounds(stream.samples, begin, stop, decoder.round_samples, decoder.sample_s)
        for first, end in itertools.pairwise([begin, *unknown, stop]):
            part = _part(session, stream.samples, decoder, first, end, axes)
            if part is None:
                aside += end - first
            else:
                parts.append(replace(part, restarted=first == begin > stream.first, after_gap=first > begin))
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
    with Spool([("device_s", np.float64), ("host_s", np.float64)], samples.folder) as arrivals:
        for _, block, last in samples.arrivals(first, end):
            arrivals.append(device_s=block["device_s"][last], host_s=block["host_s"][last])
        if len(arrivals) < _FEWEST_ARRIVALS:
            return None
        resolution_s = max(decoder.resolution_s, time.get_clock_info("monotonic").resolution)
        device, host = arrivals.column("device_s"), arrivals.column("host_s")
        clock = fit_arrivals(device, host, resolution_s=resolution_s)
    return part_with_table(session, samples, first, end, clock, axes, decoder.sample_s)


def count_rounds(samples: SampleSpool, first: int, end: int, round_samples: int, sample_s: float) -> list[int]:
    """Count what a short counter does not show at a gap: whole periods of it, `round_samples` each (0: it is long).

    Bytes arrive late, never early, so that the quickest arrivals before a gap and after it are equally late, but for
    the missing periods. Device times and gaps of the samples from `first` to before `end` are corrected. Returns the
    rows of gaps whose length stays unknown: there a part with a clock of its own begins.
    """
    if not round_samples or first == end:
        return []
    arrivals: list[tuple[Floats, Floats]] = []
    gaps: list[int] = []
    for begin, block, last in samples.arrivals(first, end):
        arrivals.append((block["host_s"][last], block["device_s"][last]))
        gaps += (begin + np.flatnonzero((block["gap"] > 0) | block["disturbed"])).tolist()
    host: Floats = np.concatenate([stamps for stamps, _ in arrivals])
    device: Floats = np.concatenate([stamps for _, stamps in arrivals])
    late = host - device
    period_s = round_samples * sample_s
    lost: dict[int, int] = {}
    unknown: list[int] = []
    for row in gaps:
        if row == first:
            continue
        place = int(device.searchsorted(float(samples.read(row, row + 1)["device_s"][0])))
        before = late[host.searchsorted(host[place] - _WINDOW_S) : place]
        after = late[place : host.searchsorted(host[place] + _WINDOW_S, side="right")]
        later_s = float(after.min() - before.min()) if len(before) else 0.0
        periods = max(0, round(later_s / period_s))
        agree = np.count_nonzero(after < after.min() + _SURE * period_s) >= _FEWEST_ARRIVALS
        if not len(before) or not agree or abs(later_s / period_s - periods) > _SURE:
            unknown.append(row)
        else:
            lost[row] = periods * round_samples
            later_s = periods * period_s
        late[place:] -= later_s
    _add_missing(samples, first, end, lost, sample_s)
    return unknown


def _add_missing(samples: SampleSpool, first: int, end: int, lost: Mapping[int, int], sample_s: float) -> None:
    """Add the samples `lost` before rows to the gaps there, and their time to all device times from there on."""
    before = 0
    for begin, block in samples.blocks(first, end if any(lost.values()) else first):
        missing = np.zeros(len(block), np.int64)
        for row, count in lost.items():
            if begin <= row < begin + len(block):
                missing[row - begin] = count
        block["gap"] += missing
        block["device_s"] += (before + np.cumsum(missing)) * sample_s
        before += int(missing.sum())
        samples.write(begin, block)


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
