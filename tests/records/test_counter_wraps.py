"""How many samples are missing, of a counter that begins anew every few samples: under which lateness of the host's
stamps the answer is right, when it is said to be in doubt, and what only the past can tell.

Streams are drawn: samples come in bursts, the host reads each burst late by whatever a busy computer takes, fetches it
in pieces, and samples are lost between pieces, a few or many rounds of the counter, with damaged bytes or cleanly.
"""

import itertools
from dataclasses import dataclass
from unittest import mock

import hardware_golden as golden
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.drivers.frames import FrameDecoder
from gradcal_jax.hardware.drivers.listening import GapCounter
from gradcal_jax.hardware.frames import framed_sensor_of
from gradcal_jax.hardware.roles import ImuBatch, join
from gradcal_jax.records import spool as spool_module
from gradcal_jax.records.counter_wraps import Doubt, resolve_wraps
from gradcal_jax.records.spool import SampleSpool

CRC = CrcOfRows(38, 32, 0x04C11DB7, 0xFFFFFFFF, 0, zeros=2)
SAMPLE_S = 0.008
ROUND = 16
ROUND_S = ROUND * SAMPLE_S


@dataclass(frozen=True)
class Piece:
    """Samples that come together, and what is lost just before them."""

    samples: int
    late_s: float
    lost: int = 0
    damaged: bool = False
    first: int = 0
    """Index of its first sample in the unit's own count; filled in by `numbered`."""


def numbered(pieces: list[Piece]) -> list[Piece]:
    found: list[Piece] = []
    count = 0
    for piece in pieces:
        count += piece.lost
        found.append(Piece(piece.samples, piece.late_s, piece.lost, piece.damaged, count))
        count += piece.samples
    return found


def stamps(pieces: list[Piece], clock_error: float = 0.0) -> list[float]:
    """When each piece is in hand: its last sample's time and how late it is, but never before the piece before it."""
    found: list[float] = []
    for piece in pieces:
        at = 100.0 + (piece.first + piece.samples) * SAMPLE_S * (1.0 + clock_error) + piece.late_s
        found.append(max(at, found[-1] + 1e-5) if found else at)
    return found


def batch(pieces: list[Piece], clock_error: float = 0.0) -> tuple[ImuBatch, NDArray[np.int64]]:
    """As the decoder gives them, through the real counter, and each sample's true index."""
    pieces = numbered(pieces)
    counter = GapCounter(step=16, modulus=256, ticks_per_s=2000.0)
    batches: list[ImuBatch] = []
    truth: list[NDArray[np.int64]] = []
    for piece, host_s in zip(pieces, stamps(pieces, clock_error), strict=True):
        index = piece.first + np.arange(piece.samples)
        counts, gaps = counter.push(16 * (index + 1) % 256, host_s, disturbed=piece.damaged)
        n = piece.samples
        batches.append(
            ImuBatch(
                host_time_s=np.full(n, host_s),
                device_time_s=counts / 2000.0,
                gyro_dps=np.zeros((n, 3)),
                acceleration_g=np.zeros((n, 3)),
                temperature_c=np.zeros((n, 3)),
                status=np.zeros(n, np.int64),
                gap_before=gaps,
                disturbed=np.arange(n) < piece.damaged,
                restarted=np.zeros(n, np.bool_),
                second_c=np.full(n, np.nan),
            )
        )
        truth.append(index)
    return join(batches), np.concatenate(truth)


def resolved(pieces: list[Piece], clock_error: float = 0.0) -> tuple[NDArray[np.int64], tuple[Doubt, ...]]:
    """By how many samples each time is wrong (0: right), and the doubts."""
    samples, truth = batch(pieces, clock_error)
    with SampleSpool() as spool:
        spool.push(samples)
        doubts = resolve_wraps(spool, 0, len(spool), ROUND, SAMPLE_S)
        found = spool.read(0, len(spool))
    index = np.rint((found["device_s"] - found["device_s"][0]) / SAMPLE_S).astype(np.int64)
    assert np.array_equal(found["gap"][1:], np.diff(index) - 1)
    return index - (truth - truth[0]), doubts


def quick(share: float) -> st.SearchStrategy[float]:
    """Lateness of less than a share of a round."""
    return st.floats(0.0, share * ROUND_S * 0.999)


LATEST = 375
ANY_LATENESS = st.floats(0.0, LATEST * SAMPLE_S)
SIZES = st.integers(1, 250)


@st.composite
def streams(draw: st.DrawFn, share: float, *, agreeing: int = 1, traceless: bool = False) -> list[Piece]:
    """Losses with quiet stretches before, between and after them, each of which holds `agreeing` arrivals that are late
    by less than `share` of a round; all others are late by anything up to three seconds."""
    pieces: list[Piece] = []
    for stretch in range(draw(st.integers(2, 4))):
        fresh = [Piece(draw(SIZES), draw(ANY_LATENESS)) for _ in range(draw(st.integers(max(3, agreeing), 9)))]
        places = st.lists(st.integers(0, len(fresh) - 1), min_size=agreeing, max_size=agreeing, unique=True)
        for place in draw(places):
            # Whatever it queued behind is in hand before its last sample is measured.
            fresh[place] = Piece(fresh[place].samples + LATEST, draw(quick(share)))
        if stretch:
            lost = draw(st.integers(1, 40)) * ROUND if traceless else draw(st.integers(0, 700))
            # A clean loss shows by the counter or not at all.
            damaged = not traceless and (lost % ROUND == 0 or draw(st.booleans()))
            fresh[0] = Piece(fresh[0].samples, fresh[0].late_s, lost, damaged)
        pieces += fresh
    return pieces


@settings(max_examples=150, deadline=None)
@given(streams(0.5), st.floats(-1e-4, 1e-4))
def test_rounds_are_right_where_some_stamp_on_either_side_is_quick_to_half_a_round(
    pieces: list[Piece], clock_error: float
) -> None:
    # The unit's clock takes its own share of the half round: over the windows' two minutes 12 ms at most.
    pieces = [Piece(p.samples, p.late_s * 0.8, p.lost, p.damaged) for p in pieces]
    wrong, _ = resolved(pieces, clock_error)
    assert not wrong.any()


@settings(max_examples=150, deadline=None)
@given(streams(0.25, agreeing=3))
def test_where_stamps_are_quick_to_a_quarter_of_a_round_every_sample_is_placed_right_and_without_doubt(
    pieces: list[Piece],
) -> None:
    wrong, doubts = resolved(pieces)
    assert not wrong.any()
    assert doubts == ()


@settings(max_examples=200, deadline=None)
@given(streams(0.75, agreeing=3))
def test_no_wrong_number_goes_unsaid_where_stamps_are_quick_to_three_quarters_of_a_round(pieces: list[Piece]) -> None:
    wrong, doubts = resolved(pieces)
    rows = np.cumsum([0, *(piece.samples for piece in pieces)])
    traces = [int(rows[place]) for place, piece in enumerate(pieces) if piece.lost or piece.damaged]
    changes = set((np.flatnonzero(np.diff(wrong)) + 1).tolist())
    assert changes <= set(traces)
    if wrong.any():
        said = {doubt.row for doubt in doubts}
        assert said
        # The first that is wrong is said to be in doubt there, not somewhere else.
        assert min(changes) in said


@settings(max_examples=100, deadline=None)
@given(streams(0.25, agreeing=3, traceless=True))
def test_whole_rounds_that_leave_no_trace_are_said_and_not_counted(pieces: list[Piece]) -> None:
    wrong, doubts = resolved(pieces)
    lost = [piece.lost for piece in pieces if piece.lost]
    assert wrong[-1] == -sum(lost)
    assert sum(doubt.rounds for doubt in doubts) * ROUND == sum(lost)
    assert not any(doubt.traced for doubt in doubts)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(SIZES, ANY_LATENESS), min_size=2, max_size=60), quick(0.5))
def test_late_stamps_alone_are_no_loss(drawn: list[tuple[int, float]], offset_s: float) -> None:
    pieces = [Piece(samples, late_s + offset_s) for samples, late_s in drawn]
    wrong, doubts = resolved(pieces)
    assert not wrong.any()
    # Where the computer is late from some place on until the end, it may be said; nothing is counted.
    assert not any(doubt.traced for doubt in doubts)


def test_a_computer_that_is_busy_between_quick_arrivals_raises_no_doubt() -> None:
    late = [0.001, 2.5, 1.9, 0.4, 0.002, 0.9, 0.001, 0.001] * 20
    wrong, doubts = resolved([Piece(400, late_s) for late_s in late], clock_error=2e-4)
    assert not wrong.any()
    assert doubts == ()


def test_a_full_buffer_keeps_the_old_and_what_comes_late_before_the_loss_is_placed_right() -> None:
    before = [Piece(16, 0.001) for _ in range(20)]
    # Nobody fetched anything for two seconds: what the buffer held is late, 250 samples behind it are gone.
    kept = [Piece(97, 2.0), Piece(97, 1.3), Piece(97, 0.5)]
    after = [Piece(16, 0.002, lost=250)] + [Piece(16, 0.001) for _ in range(20)]
    wrong, doubts = resolved([*before, *kept, *after])
    assert not wrong.any()
    assert doubts == ()


@pytest.mark.parametrize(("late", "said"), [(0.0, False), (0.2, False), (0.3, True), (0.6, True)])
def test_lateness_that_stays_is_in_doubt_from_a_quarter_of_a_round_on(late: float, said: bool) -> None:
    before = [Piece(16, 0.0) for _ in range(30)]
    after = [Piece(16, late * ROUND_S, lost=40)] + [Piece(16, late * ROUND_S) for _ in range(30)]
    _, doubts = resolved([*before, *after])
    assert bool(doubts) == said
    if said:
        assert f"{late + 2 if late > 0.5 else late:.2f}"[-2:] in doubts[0].why


# A repetition of 16 datagrams ago, which has the count that is due, and one lost: all goes on as if none were.
@example([(0, 0)] * 3 + [(0, -1)] * 4 + [(8, 7), (1, 0)], [(11, 0), (13, 0)])
@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 14), st.integers(-1, 13)), min_size=2, max_size=60),
    st.lists(st.tuples(st.integers(1, 60), st.sampled_from([0, 0, 1, 20])), max_size=8),
)
def test_datagrams_that_come_twice_count_once_whatever_was_lost_between(
    drawn: list[tuple[int, int]], cuts: list[tuple[int, int]]
) -> None:
    """Each datagram after a loss of less than a round, and then perhaps once more one of the last that came."""
    came: list[int] = []
    sent: list[bytes] = []
    repeated = index = 0
    for lost, back in drawn:
        index += lost + 1
        came.append(index)
        sent.append(datagram(index))
        if 0 <= back < len(came):
            sent.append(datagram(came[-1 - back]))
            repeated += 1
    data = b"".join(sent)
    decoder = FrameDecoder(framed_sensor_of("stim300"))
    places = sorted({0, len(data), *((42 * whole + part) % len(data) for whole, part in cuts)})
    batches = [decoder.push(data[a:b], 0.0) for a, b in itertools.pairwise(places)]
    samples = join(batches)
    assert np.array_equal(
        np.rint((samples.device_time_s - samples.device_time_s[0]) / SAMPLE_S), np.array(came) - came[0]
    )
    assert (decoder.repeated_datagrams, decoder.bad_bytes) == (repeated, 0)


def datagram(index: int) -> bytes:
    """Rates that differ from sample to sample, as a unit's do."""
    body = golden.STIM300_A5[:2] + index.to_bytes(2, "big") + golden.STIM300_A5[4:35]
    body += bytes([16 * index % 256]) + golden.STIM300_A5[36:38]
    crc = CRC(np.frombuffer(body, np.uint8)[None])[0]
    return body + int(crc).to_bytes(4, "big")


@pytest.mark.long
@settings(max_examples=100, deadline=None)
@given(streams(0.75, agreeing=3), st.sampled_from([3, 64, 1000]))
def test_the_stream_is_read_in_blocks_of_any_size(pieces: list[Piece], rows: int) -> None:
    """The windows reach over the edges of blocks."""
    whole = resolved(pieces)
    with mock.patch.object(spool_module, "BLOCK", rows):
        wrong, doubts = resolved(pieces)
    assert np.array_equal(wrong, whole[0])
    assert doubts == whole[1]


def test_absolute_stamps_are_left_alone() -> None:
    samples, _ = batch([Piece(16, 0.0), Piece(16, 5.0, lost=100)])
    with SampleSpool() as spool:
        spool.push(samples)
        assert resolve_wraps(spool, 0, len(spool), 0, SAMPLE_S) == ()
        assert np.array_equal(spool.read(0, len(spool))["device_s"], samples.device_time_s)


# ----------------------------------------------------------------------------------------------- what the past can tell


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(SIZES, ANY_LATENESS), min_size=1, max_size=20),
    st.integers(0, 255),
    st.integers(0, 2000),
    quick(0.5),
    quick(0.5),
)
def test_a_live_decoder_is_right_where_the_chunk_behind_the_damage_is_late_by_less_than_half_a_round(
    before: list[tuple[int, float]], place: int, lost: int, quickest_s: float, then_s: float
) -> None:
    pieces = [Piece(samples, late_s + ROUND_S) for samples, late_s in before]
    pieces.insert(place % (len(pieces) + 1), Piece(16, quickest_s))
    samples, truth = batch([*pieces, Piece(20, then_s, lost, damaged=True)])
    index = np.rint(samples.device_time_s / SAMPLE_S).astype(np.int64)
    # What it really waited: nothing overtakes what came before it.
    ended = np.flatnonzero(np.append(np.diff(samples.host_time_s) > 0.0, True))
    waited = samples.host_time_s[ended] - (truth[ended] + 1) * SAMPLE_S
    if abs(waited[-1] - waited[:-1].min()) < 0.499 * ROUND_S:
        assert np.array_equal(index - index[0], truth - truth[0])
    else:
        # It queued behind something later: the past does not tell, and it is wrong by whole rounds at most.
        assert np.all((index - index[0] - (truth - truth[0])) % ROUND == 0)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(SIZES, ANY_LATENESS, st.integers(0, ROUND - 1)), min_size=1, max_size=30))
def test_the_counter_alone_shows_every_loss_of_less_than_a_round_however_late(
    drawn: list[tuple[int, float, int]],
) -> None:
    samples, truth = batch([Piece(count, late_s, lost) for count, late_s, lost in drawn])
    index = np.rint(samples.device_time_s / SAMPLE_S).astype(np.int64)
    assert np.array_equal(index - index[0], truth - truth[0])
