"""Logs made of journals that were written by hand, with the bytes of simulated units: a table that turns, bursts that a
busy computer fetches in pieces and late, samples that are lost, units that begin anew in the middle.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hardware_bench import perfect, sensor_on_table, short_recipe
from journal_log import angles_of_rests, log_of
from simulated_devices.frames import SimulatedFrames

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.journal import Chunk, Event, JournalContents
from gradcal_jax.hardware.simulate.plants import AxisPlant
from gradcal_jax.records.log import Log
from gradcal_jax.records.table_angles import AxisCourse, Held, held_rates
from gradcal_jax.spec.rig import TEMPLATE, parse_rig

START_S = 1000.0
RATE_DPS, ACCELERATION_DPS2 = 200.0, 300.0
TURN_S = 360.0 / RATE_DPS + RATE_DPS / ACCELERATION_DPS2
READ_BYTES = 4095  # that a Linux terminal hands over at once
Turn = tuple[float, float]
"""When the table begins to turn, s, and where to, deg."""


def lose_101(burst: int, data: bytes) -> bytes:
    """Of bursts of half a second the 80th and most of the next one are lost, datagram by datagram."""
    whole = {80: 10**6, 81: (101 - 62) * 42}
    return data[whole.get(burst, 0) :]


def recorded(records: Sequence[Event | Chunk]) -> Log:
    """The log of a run of one step, of what its journal holds."""
    log = log_of(JournalContents(list(records)), short_recipe(), parse_rig(TEMPLATE))
    if log.standstill is not None:
        numbers = np.unique(log.standstill[log.standstill >= 0])
        assert numbers.tolist() == list(range(len(numbers)))
    return log


def session(
    turns: Sequence[Turn],
    end_s: float,
    *,
    start_s: float = START_S,
    wall_clock_s: float = 0.0,
    number: int = 0,
    simulated: bool = True,
    clock_error: float = 0.0,
    burst_s: float = 0.5,
    late_s: Callable[[int], float] = lambda number: 0.002,
    piece_s: float = 0.02,
    lost: Callable[[int, bytes], bytes] = lambda burst, data: data,
    reboots_s: Sequence[float] = (),
    happened: Sequence[Event] = (),
) -> list[Event | Chunk]:
    """What the journal holds of a part of a run that begins at `start_s` by the run's clock and at `wall_clock_s` by
    the one on the wall: the table turns, a unit whose clock errs sends every `burst_s`, the host has the first piece of
    a burst `late_s(number)` after it was sent and each other `piece_s` later, and loses what `lost` leaves out."""
    clock = VirtualClock(start_s)
    plant = AxisPlant(None, start_s)
    sensor = sensor_on_table(clock, perfect(clock_error=clock_error), axis=plant, sample_rate_hz=125.0)
    unit = SimulatedFrames(sensor, clock)
    begun = {"number": number, "simulated": simulated, "wall_clock_s": wall_clock_s}
    records: list[Event | Chunk] = [
        *happened,
        Event(start_s, "session", begun),
        Event(start_s, "configuration", {"device": "imu1", "registers": {}}),
        Event(start_s + 4.0, "step begins", {"step": "turns", "number": 0, "begins_s": start_s + 4.0, "data": True}),
        Event(start_s + end_s, "ending", {"exit_status": "success"}),
    ]

    def angle(at_s: float, position_deg: float) -> None:
        data = {"axis": "table", "moving": False, "time_s": at_s, "position_deg": position_deg}
        records.append(Event(at_s, "angle", data))

    angle(start_s + 4.0, 0.0)
    waiting, rebooting, at_deg, in_hand_s = list(turns), list(reboots_s), 0.0, 0.0
    for burst in range(round(end_s / burst_s)):
        now = start_s + (burst + 1) * burst_s
        while waiting and start_s + waiting[0][0] < now:
            after_s, to_deg = waiting.pop(0)
            began = start_s + after_s
            records.append(Event(began, "move", {"axis": "table", "began_s": began, "kind": "turn"}))
            plant.move_to(began, to_deg, RATE_DPS, ACCELERATION_DPS2)
            angle(began + abs(to_deg - at_deg) / 360.0 * TURN_S + 0.01, to_deg)
            at_deg = to_deg
        clock.sleep_until(now)
        if rebooting and start_s + rebooting[0] < now:
            rebooting.pop(0)
            sensor.take(sensor.due(now))
            unit.reboot()
        data = lost(burst, b"".join(unit.emit(now)))
        for place in range(0, len(data), READ_BYTES):
            in_hand_s = max(now + late_s(burst) + place // READ_BYTES * piece_s, in_hand_s + 1e-6)
            records.append(Chunk(in_hand_s, "imu1", True, data[place : place + READ_BYTES]))
    return sorted(records, key=lambda record: record.time_s)


BUSY = {"burst_s": 2.0, "late_s": lambda number: 0.01 + 0.005 * (number % 3)}
THERE_AND_BACK = ((14.0, 360.0), (14.0 + TURN_S + 10.0, 0.0))


def require_rest_in_standstills(log: Log) -> None:
    resting = log.standstill >= 0
    assert resting.any()
    # The Earth turns, too.
    assert np.degrees(np.abs(log.rate_rad_per_s[0, resting, 2])).max() < 0.02


def require_turns(log: Log, turned_deg: list[float], share: float = 0.5) -> None:
    """By the table and by the sensor, from a row of each standstill to one of the next: at a share of its rows."""
    require_rest_in_standstills(log)
    numbers = [int(n) for n in dict.fromkeys(log.standstill.tolist()) if n >= 0]
    standing = [np.flatnonzero(log.standstill == n) for n in numbers]
    rows = [own[min(int(share * len(own)), len(own) - 1)] for own in standing]
    interval_s = float(np.median(np.diff(log.time_s)))
    about = np.degrees(log.rate_rad_per_s[0, :, 2])
    sensor = [about[start + 1 : end + 1].sum() * interval_s for start, end in itertools.pairwise(rows)]
    assert np.degrees(np.diff(angles_of_rests(log)[numbers])).tolist() == pytest.approx(turned_deg, abs=1e-9)
    assert sensor == pytest.approx(turned_deg, abs=0.1)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_burst_that_is_fetched_in_pieces_moves_no_row_into_a_rest(share):
    log = recorded(session(THERE_AND_BACK, 40.0, **BUSY))
    require_turns(log, [360.0, -360.0], share)
    assert abs(float(log.provenance["clock_rate_error"])) < 2e-3
    assert log.findings == ()


@pytest.mark.parametrize("rest_s", [0.1, 0.3, 0.6, 1.0, 2.0])
def test_a_rest_that_a_busy_computer_slept_through_holds_no_row_of_a_turn(rest_s):
    # As it was caught in the proof of kills: of ten seconds three tenths were left, and rows of the turns stood in it.
    turns = ((14.0, 360.0), (14.0 + TURN_S + rest_s, 0.0))
    require_turns(recorded(session(turns, 40.0, **BUSY)), [360.0, -360.0] if rest_s > 0.2 else [0.0])


def test_stamps_that_are_unsure_shorten_every_standstill_and_it_is_said():
    # Up and down by half a second, for seconds at a time: no line fits.
    log = recorded(session(THERE_AND_BACK, 40.0, burst_s=0.4, late_s=lambda n: 0.25 * (1.0 + math.sin(n / 8.0))))
    require_rest_in_standstills(log)
    assert [finding.kind for finding in log.findings if finding.kind == "late stamps"] == ["late stamps"]


def test_datagrams_lost_whole_are_counted_with_their_rounds():
    # 101 datagrams without a damaged byte: the counter alone shows five.
    log = recorded(session(THERE_AND_BACK, 60.0, lost=lose_101))
    (gap,) = log.findings
    assert (gap.kind, gap.message) == ("gap", "about 101 samples are missing at 1 places")
    assert log.stretch_starts.tolist()[1:] == [int(np.argmax(np.diff(log.time_s))) + 1]
    assert np.diff(log.time_s).max() == pytest.approx(102 * 0.008)
    require_rest_in_standstills(log)


def test_a_unit_that_begins_anew_in_mid_run_splits_the_log_and_is_said():
    turns = (*THERE_AND_BACK, (60.0, 360.0), (75.0, 0.0))
    log = recorded(session(turns, 90.0, reboots_s=(48.3,)))
    kinds = {finding.kind: finding for finding in log.findings}
    assert "restarted 1 time during" in kinds["unit restarted"].message
    (start,) = log.stretch_starts.tolist()[1:]
    assert 44.0 < log.time_s[start] - log.time_s[0] < 46.0
    # Both parts lie on the computer's clock.
    np.testing.assert_allclose(log.time_s, log.host_time_s, atol=0.01)
    require_turns(log, [360.0, -360.0, 360.0, -360.0])


# ------------------------------------------------------------------------------------------ pauses, axes and sessions


def repeated(start_s: float, end_s: float) -> list[Event]:
    """What the journal holds of a step that was refused at its begin, which stops every axis, and made again later."""
    begin, end = START_S + start_s, START_S + end_s
    return [
        Event(begin, "not done", {"step": "turns", "number": 1, "why": "late"}),
        Event(begin, "stopped", {"axis": "table"}),
        Event(end, "seam", {"step": "turns", "why": "the step is repeated"}),
        Event(end, "step begins", {"step": "turns", "number": 1, "begins_s": end, "data": True}),
    ]


def test_a_repeated_step_ends_stretch_and_standstill_and_what_stood_stands_behind_it():
    # Nothing is read again behind it: of a table that is turned by hand the angle was typed before.
    log = recorded(session(THERE_AND_BACK, 70.0, happened=repeated(45.0, 55.0)))
    (start,) = log.stretch_starts.tolist()[1:]
    edges = log.host_time_s[[start - 1, start]] - START_S
    np.testing.assert_allclose(edges, [45.0, 55.0], atol=0.01)
    before, behind = log.standstill[start - 100], log.standstill[start + 100]
    assert (before, behind) == (2, 3)
    assert np.degrees(angles_of_rests(log)).tolist() == pytest.approx([0.0, 360.0, 0.0, 0.0])
    assert np.count_nonzero(log.standstill == behind) > 14.0 * 125.0


DAY_S = 86400.0


@pytest.mark.parametrize(
    ("began_s", "again_s", "later_s", "simulated", "apart_s"),
    [
        # The computer was up for ten days, went off, and was switched on after eight hours.
        (10.0 * DAY_S, 300.0, DAY_S / 3.0, False, DAY_S / 3.0),
        # It had just been switched on; two days later it has been up for longer than then.
        (100.0, 5000.0, 2.0 * DAY_S, False, 2.0 * DAY_S),
        # It was never off, and its clock on the wall was set.
        (100.0, 5000.0, 4893.0, False, 4900.0),
        (5000.0, 9000.0, -DAY_S, False, 4000.0),
        # Switched on anew with a clock on the wall that knows nothing: data ended 30 s after the session began, and
        # they begin again 4 s after the next one did.
        (5000.0, 300.0, -DAY_S, False, 30.0 + 60.0 - 4.0),
        # Simulated devices go on a minute later whenever somebody says so.
        (100.0, 190.0, DAY_S, True, 90.0),
    ],
)
def test_how_much_later_a_run_went_on(began_s, again_s, later_s, simulated, apart_s):
    starts = ((began_s, 0.0), (again_s, later_s), (again_s + 600.0, later_s + 600.0))
    log = recorded(
        record
        for number, (start_s, later) in enumerate(starts)
        for record in session((), 30.0, start_s=start_s, wall_clock_s=1.7e9 + later, number=number, simulated=simulated)
    )
    begins = log.host_time_s[log.stretch_starts] - log.host_time_s[0]
    np.testing.assert_allclose(begins, [0.0, apart_s, apart_s + 600.0], atol=0.01)
    np.testing.assert_allclose(log.time_s, log.host_time_s, atol=0.01)
    assert log.provenance["clock_from_row"].split(", ") == [str(row) for row in log.stretch_starts]


def test_a_unit_of_a_fast_clock_that_begins_anew_goes_on_where_the_computer_says():
    # Its clock is ahead by more than it needs to begin anew.
    why = {"step": "turns", "why": "the run was resumed; the step begins again"}
    first, *rest = session((), 500.0, simulated=False, clock_error=5e-3, reboots_s=(480.3,))
    again = Event(START_S + 600.0, "session", {"number": 1, "simulated": False, "wall_clock_s": 600.0})
    seams = [Event(START_S + after_s, "seam", why) for after_s in (1.0, 601.0)]
    log = recorded([first, seams[0], *rest, again, seams[1]])
    (start,) = log.stretch_starts.tolist()[1:]
    by_host = float(log.host_time_s[start] - log.host_time_s[start - 1])
    assert 0.0 < by_host < 2.0
    by_sensor = by_host / (1.0 + float(log.provenance["clock_rate_error"]))
    assert log.time_s[start] - log.time_s[start - 1] == pytest.approx(by_sensor, abs=1e-6)
    # One seam a session, also of the session that gave no data, however many parts there are of it.
    assert (log.provenance["sessions"], log.provenance["seams"]) == ("2", "2")


def test_a_table_that_stands_only_behind_the_last_row_slows_down_before():
    spin, rest = Held(10.0, 20.0, 300.0), Held(23.0)
    rates = np.degrees(held_rates(AxisCourse([spin, rest], []), np.array([12.0, 20.0, 21.0])))
    assert rates == pytest.approx([300.0, 300.0, 200.0])
