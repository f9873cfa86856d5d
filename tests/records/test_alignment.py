"""Somebody else's recording laid on the run's clock: where it was made, how sure that is, and when it is refused."""

from dataclasses import replace

import numpy as np
import pytest
from motion_and_recording import Motion, Recorded, readings, recording, turns

from gradcal_jax.records.alignment import Alignment, AngleTrack, NoAlignment, align

UNKNOWN = "from another run|agrees with the run at more than one start time"


def one(seed: int, cycles: int = 12) -> tuple[Alignment, Recorded]:
    random = np.random.default_rng(seed)
    motion = turns(random, cycles)
    end = float(motion.time_s[-1])
    unit = recording(
        random, motion, begins_s=-random.uniform(0.0, 2000.0), ends_s=end + 200.0, ppm=50.0 * random.choice([-1.0, 1.0])
    )
    found = align(unit.time_s, unit.rate_dps, AngleTrack(*readings(random, motion)))
    return found, unit


def errors(found: Alignment, unit: Recorded) -> tuple[float, float]:
    """Of offset and rate, in their own sigmas."""
    offset_s = found.offset_s - unit.host_s(found.middle_s)
    return float(offset_s) / found.offset_std_s, (found.rate - unit.rate) / found.rate_std


def test_offset_and_slope_are_found_within_their_sigmas():
    sigmas = np.array([errors(*one(seed)) for seed in range(8)])
    assert np.abs(sigmas).max() < 4.0
    found, unit = one(3)
    assert found.offset_std_s < 1e-3
    assert found.rate_std < 2e-6
    assert found.rate - 1.0 == pytest.approx(unit.rate - 1.0, abs=5e-6)


@pytest.mark.evidence
def test_offset_and_slope_of_two_hundred_runs():
    sigmas = np.array([errors(*one(seed)) for seed in range(1000, 1200)])
    spread, worst = sigmas.std(axis=0), np.abs(sigmas).max(axis=0)
    print(f"200 runs: offset spread {spread[0]:.3f} sigma, worst {worst[0]:.2f}; slope {spread[1]:.3f}, {worst[1]:.2f}")
    # 200 draws: the spread of a standard deviation is 5 %.
    assert np.all((spread > 0.8) & (spread < 1.15))
    assert np.mean(np.abs(sigmas) < 1.0, axis=0).min() > 0.6
    assert worst.max() < 4.5


def require_aligned(unit: Recorded, track: AngleTrack) -> None:
    assert np.abs(errors(align(unit.time_s, unit.rate_dps, track), unit)).max() < 4.0


def run_and_unit(seed: int, *, alike: bool = False) -> tuple[np.random.Generator, Motion, AngleTrack]:
    random = np.random.default_rng(seed)
    motion = turns(random, 10, alike=alike)
    return random, motion, AngleTrack(*readings(random, motion))


def test_another_run_or_another_axis_is_refused():
    random, motion, track = run_and_unit(5)
    other = recording(random, turns(random, 10), 0.0, 1500.0)
    unit = recording(random, motion, -50.0, ppm=-50.0)
    still = 0.3 * random.standard_normal((len(unit.time_s), 1))
    for time_s, rate_dps, said in (
        (other.time_s, other.rate_dps, UNKNOWN),
        (unit.time_s, still, "another axis"),
        (unit.time_s, 0.5 * unit.rate_dps, r"sensor measures 0\.5"),  # an axis that lies askew senses some of the turns
        (unit.time_s, -unit.rate_dps, "opposite sign"),
    ):
        with pytest.raises(NoAlignment, match=said):
            align(time_s, rate_dps, track)


def test_turns_that_are_all_alike_tell_their_place_only_with_their_first_or_last():
    random, motion, track = run_and_unit(6, alike=True)
    end = float(motion.time_s[-1])
    whole = recording(random, motion, -500.0, end + 500.0)
    require_aligned(whole, track)
    # What turns in one and not in the other, and the other way round, counts against a place.
    inside = (track.time_s > 98.0) & (track.time_s < end - 128.0)
    short = AngleTrack(track.time_s[inside], track.angle_deg[inside])
    close = recording(random, motion, 95.0, end - 125.0)
    require_aligned(close, short)
    middle = recording(random, motion, 0.4 * end, 0.7 * end)
    with pytest.raises(NoAlignment, match="more than one start time"):
        align(middle.time_s, middle.rate_dps, track)


def test_a_part_of_a_run_whose_turns_differ_is_enough_and_a_gap_does_no_harm():
    random, motion, track = run_and_unit(7)
    end = float(motion.time_s[-1])
    unit = recording(random, motion, 0.3 * end, 1.4 * end, ppm=-50.0)
    require_aligned(unit, track)
    kept = np.r_[:20000, 23000 : len(unit.time_s)]
    require_aligned(replace(unit, time_s=unit.time_s[kept], rate_dps=unit.rate_dps[kept]), track)


def test_readings_at_rest_alone_do_not_tell_the_clock():
    random, motion, track = run_and_unit(8)
    _, rate = motion.at(track.time_s)
    rests = np.abs(rate) == 0.0
    unit = recording(random, motion, -10.0)
    with pytest.raises(NoAlignment, match=f"readings|{UNKNOWN}"):
        align(unit.time_s, unit.rate_dps, AngleTrack(track.time_s[rests], track.angle_deg[rests]))


def test_the_direction_of_the_axis_in_a_unit_is_found():
    random, motion, track = run_and_unit(9)
    unit = recording(random, motion, -50.0)
    rates = unit.rate_dps * np.array([0.6, -0.48, 0.64]) + 0.01 * random.standard_normal((len(unit.time_s), 3))
    require_aligned(replace(unit, rate_dps=rates), track)
    # Gyros across the axis show what is hardly another signal: their part of the direction is arbitrary.
    across = [1e-3 * unit.rate_dps + size * np.abs(unit.rate_dps) for size in (1e-6, -1e-6)]
    require_aligned(replace(unit, rate_dps=np.hstack([unit.rate_dps, *across])), track)
