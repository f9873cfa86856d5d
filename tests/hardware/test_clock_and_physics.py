"""Virtual time never overtakes work or bytes; the physics behind the simulated devices is what it says."""

import time

import numpy as np
import pytest
from hardware_bench import sensor_on_table

from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.simulate.imu import ImuTruth, Process, TriadTruth
from gradcal_jax.hardware.simulate.plants import AxisPlant, AxisTruth, ChamberPlant, ChamberTruth

# --- clock ------------------------------------------------------------------------------------------------------------


def test_real_clock_follows_the_monotonic_clock_alone(monkeypatch):
    clock = RealClock()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    before = clock.now()
    clock.sleep(0.05)
    assert 0.05 <= clock.now() - before < 0.5


# --- plants -----------------------------------------------------------------------------------------------------------


def test_load_trails_a_ramp_by_its_time_constants():
    truth = ChamberTruth(start_c=0.0, air_time_constant_s=40.0, load_time_constant_s=240.0)
    plant = ChamberPlant(truth)
    plant.conditioning = True
    plant.set_point_c = 0.0
    plant.command(0.0, target_c=60.0, gradient_k_per_min=1.0)
    now = 3000.0
    plant.at(now)
    assert plant.set_point_c == pytest.approx(50.0, abs=1e-9)
    assert plant.set_point_c - plant.air_c == pytest.approx(40.0 / 60.0, rel=0.02)
    assert plant.air_c - plant._load_c == pytest.approx(240.0 / 60.0, rel=0.01)
    before, after = plant.load_at(np.array([now - 60.0, now]))
    assert after - before == pytest.approx(1.0, rel=0.01)


def test_a_rate_is_held_as_well_as_the_table_can_and_its_encoder_does_not_see_it():
    plant = AxisPlant(AxisTruth(rate_accuracy=200e-6, seed=5))
    errors = []
    for index in range(300):
        told = (100.0, -300.0)[index % 2]
        plant.spin(100.0 * index, told, 1e6)
        begin, end = 100.0 * index + 1.0, 100.0 * index + 99.0
        errors.append((plant.state(end)[0] - plant.state(begin)[0]) / (98.0 * told) - 1.0)
        assert (plant.reading(end) - plant.reading(begin)) / 98.0 == pytest.approx(told, rel=1e-9)
    assert np.std(errors) == pytest.approx(200e-6, rel=0.15)
    assert abs(np.mean(errors)) < 4.0 * 200e-6 / np.sqrt(300.0)


def test_encoder_errors_are_of_the_kind_that_was_asked_for():
    plant = AxisPlant(AxisTruth(standstill_offset_deg=0.05, seed=3))
    offsets = []
    for index in range(200):
        plant.move_to(100.0 * index, 360.0 * (index + 1), 300.0, 300.0)
        readings = {plant.reading(100.0 * index + 50.0 + k) for k in range(3)}
        assert len(readings) == 1  # one draw a standstill: reading again does not average it
        offsets.append(readings.pop() - 360.0 * (index + 1))
    assert np.std(offsets) == pytest.approx(0.05, rel=0.2)
    once = AxisPlant(AxisTruth(harmonics=((1, 0.0, 0.1),)))
    once.set_zero(0.0, 90.0)
    assert once.reading(1.0) == pytest.approx(90.1)
    late = AxisPlant(AxisTruth(timing_error_s=0.002, seed=4))
    assert late.reading(0.0) == 0.0  # nothing moves, and no instant is better than another
    late.spin(0.0, 100.0, 1e6)
    read = [late.reading(10.0 + 0.1 * k) - late.state(10.0 + 0.1 * k)[0] for k in range(400)]
    assert np.std(read) == pytest.approx(100.0 * 0.002, rel=0.15)


def test_an_axis_behind_a_gear_turns_by_less_than_its_motor_counts():
    """By the scale error always, and after each reversal by the backlash, too."""
    plant = AxisPlant(AxisTruth(scale_error=1e-3, backlash_deg=0.2))
    plant.move_to(0.0, 90.0, 50.0, 100.0)
    assert plant.reading(10.0) == pytest.approx(90.0)
    begins = plant.position(np.array([10.0]))[0]
    plant.move_to(11.0, 180.0, 50.0, 100.0)
    middle = plant.position(np.array([20.0]))[0]
    plant.move_to(21.0, 90.0, 50.0, 100.0)
    ends = plant.position(np.array([21.05, 30.0]))
    assert middle - begins == pytest.approx(90.0 * 0.999)
    assert ends[0] == middle  # the motor has turned back by 0.125 deg
    assert middle - ends[1] == pytest.approx((90.0 - 0.2) * 0.999)
    # A reversal without a standstill: one phase of constant acceleration, in and after which the axis stands a while.
    plant.spin(40.0, 20.0, 100.0)
    plant.spin(42.0, -20.0, 100.0)
    motor = [plant.state(t)[0] for t in (42.2, 42.25, 43.0)]
    axis = plant.position(np.array([42.2, 42.25, 43.0])) / 0.999
    np.testing.assert_allclose(axis, [motor[0] - 0.1, motor[0] - 0.1, motor[2] + 0.1])


def test_a_hand_turns_unevenly_and_ends_in_time():
    plant = AxisPlant(None, 0.0)
    plant.set_zero(0.0, 10.0)
    plant.turn_by_hand(5.0, -710.0, 30.0)
    times = np.linspace(5.0, 35.0, 3001)
    rates = np.array([plant.state(time)[1] for time in times])
    angles = plant.position(times)
    assert (plant.moving(34.9), plant.moving(35.1)) == (True, False)
    np.testing.assert_allclose(angles[[0, -1]], [10.0, -710.0], rtol=1e-12)
    np.testing.assert_allclose(np.gradient(angles, times)[1:-1], rates[1:-1], atol=0.1)
    # From rest to rest without a reversal, with a peak of 2.4 times the mean, in the first half.
    assert rates.max() < 1e-9
    assert rates.min() == pytest.approx(-2.4 * 24.0, rel=0.02)
    assert rates[1200] < 1.5 * rates[1800]


# --- sensor -----------------------------------------------------------------------------------------------------------


def test_sensor_samples_do_not_depend_on_how_many_are_taken_at_once():
    drifts = (Process(1.0, 10.0, 1.0), Process(0.1, 100.0, 1.0), Process(1e-4, 60.0, 0.0, 1.0))
    truth = ImuTruth({"gyro": TriadTruth({}, white=0.01, walk=1e-3, drifts=drifts)})
    one, many = (sensor_on_table(VirtualClock(), truth, seed=9) for _ in range(2))
    whole = one.take(400).rate_dps
    parts = np.concatenate([many.take(count).rate_dps for count in (1, 2, 16, 31, 50, 300)])
    np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-12)


def test_a_command_that_was_held_up_changes_nothing_that_the_sensor_was_told():
    plant = AxisPlant(None, 0.0)
    told = plant.position(np.linspace(0.0, 10.2, 52))
    # It was given at 10 s, and carried out when the samples had got further.
    plant.move_to(10.0, 360.0, 150.0, 200.0)
    np.testing.assert_array_equal(plant.position(np.linspace(0.0, 10.2, 52)), told)
    steps = np.diff(plant.position(np.linspace(10.2, 20.0, 1000)))
    assert float(steps.sum()) == pytest.approx(360.0)
    assert float(np.abs(np.diff(steps)).max()) < 0.1
