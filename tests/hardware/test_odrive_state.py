"""What an ODrive remembers between commands, and what its driver makes of it: no detour, no creeping, no old error."""

import numpy as np
import pytest
from hardware_bench import odrive_bench
from simulated_devices.line_clock import LineClock
from simulated_devices.odrive import ODriveOptions, SimulatedODrive

from gradcal_jax.hardware.drivers.odrive import CLOSED_LOOP, IDLE, ODriveAxis, ODriveConfig
from gradcal_jax.hardware.errors import DeviceFault
from gradcal_jax.hardware.roles import AxisSafe


def travelled(device: SimulatedODrive, clock: LineClock, duration_s: float) -> tuple[float, float]:
    """The fastest rate (deg/s) and the whole way (deg) of the axis in the time that now passes."""
    began = clock.now()
    clock.sleep(duration_s)
    times = np.linspace(began, clock.now(), 4001)
    positions = device.axes[0].plant.position(times)
    steps = np.abs(np.diff(positions))
    return float(steps.max() / (times[1] - times[0])), float(steps.sum())


@pytest.mark.parametrize("ends_by", ["stop", "safe", "another move", "a new driver after a kill"])
def test_a_move_after_a_spin_goes_straight_there_at_the_rate_that_was_asked_for(ends_by: str) -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.move_to(90.0, 60.0, 100.0)
        clock.sleep(5.0)
        axis.spin(200.0, 200.0)
        clock.sleep(4.0)
        if ends_by == "stop":
            axis.stop()
        elif ends_by == "safe":
            assert axis.safe(AxisSafe.HOLD).verified
        elif ends_by.startswith("a new"):
            axis = ODriveAxis(axis._exchange, ODriveConfig(reply_timeout_s=0.2))
            assert axis.safe(AxisSafe.HOLD).verified
        here = axis.read().position_deg if ends_by != "another move" else None
        goal = 1000.0 if here is None else here + 40.0
        axis.move_to(goal, 30.0, 100.0)
        begun_at = device.axes[0].plant.state(clock.now())[0]
        fastest, way = travelled(device, clock, 12.0)
        assert fastest < 30.5
        assert way == pytest.approx(abs(goal - begun_at) if here is not None else way, abs=0.5)
        assert way < 30.0 * 12.0 + 1.0


@pytest.mark.parametrize("by", ["stop", "safe"])
def test_what_stands_is_held_at_an_angle_under_an_unbalanced_load(by: str) -> None:
    clock = LineClock()
    with odrive_bench(clock, ODriveOptions(unbalanced_dps=0.2)) as (axis, device, _):
        axis.spin(100.0, 200.0)
        clock.sleep(3.0)
        if by == "stop":
            axis.stop()
        else:
            report = axis.safe(AxisSafe.HOLD)
            assert report.verified
            assert "held by the position loop" in report.evidence
        stands_at = device.axes[0].plant.state(clock.now())[0]
        clock.sleep(3600.0)
        assert device.axes[0].plant.state(clock.now())[0] == pytest.approx(stands_at, abs=0.01)
        assert device.axes[0].state == CLOSED_LOOP


def test_an_old_velocity_and_an_old_mode_do_not_turn_the_axis_when_the_loop_closes() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        values = device.axes[0].values
        values["controller.input_vel"] = 1.0
        values["controller.config.control_mode"] = values["controller.config.input_mode"] = 2.0
        axis.move_to(20.0, 10.0, 100.0)
        fastest, way = travelled(device, clock, 5.0)
        assert fastest < 10.2
        assert way == pytest.approx(20.0, abs=0.1)


def test_the_errors_of_before_are_shown_and_cleared_and_those_that_come_back_are_faults() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.spin(50.0, 100.0)
        axis.arm_watchdog()
        clock.sleep(10.0)
        # Mid-run it is a fault; a run that begins clears it, and says that it was there.
        assert axis.read().faults == ("0x800 (watchdog expired)",)
        after = ODriveAxis(axis._exchange, ODriveConfig(reply_timeout_s=0.2))
        after.home()
        assert after.read().faults == ()
        assert after.read().warnings == ("0x800 (watchdog expired)",)
        after.move_to(10.0, 50.0, 100.0)
        clock.sleep(60.0)
        assert after.read().faults == ()
        device.fault(0x40)
        device._answer = lambda words, answer=device._answer: [] if words[0] == "sc" else answer(words)
        with pytest.raises(DeviceFault, match=r"0x40 \(motor failed\) after"):
            ODriveAxis(axis._exchange, ODriveConfig(reply_timeout_s=0.2)).home()


def test_a_run_that_was_killed_is_taken_under_control_again() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.spin(50.0, 100.0)
        axis.arm_watchdog()
        clock.sleep(10.0)  # nobody feeds it: it is idle and coasts
        assert axis.read().faults
        assert device.axes[0].state == IDLE
        report = ODriveAxis(axis._exchange, ODriveConfig(reply_timeout_s=0.2)).safe(AxisSafe.HOLD)
        assert report.verified
        assert "cleared: 0x800 (watchdog expired)" in report.evidence
        clock.sleep(3600.0)
        assert (device.axes[0].state, device.axes[0].error) == (CLOSED_LOOP, 0)


@pytest.mark.parametrize("policy", list(AxisSafe))
def test_no_watchdog_is_left_behind(policy: AxisSafe) -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.spin(50.0, 100.0)
        axis.arm_watchdog()
        assert axis.safe(policy).verified
        clock.sleep(3600.0)
        assert device.axes[0].error == 0


def test_an_axis_that_was_never_powered_is_left_idle() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        assert axis.safe(AxisSafe.HOLD).verified
        assert device.axes[0].state == IDLE


def test_generation_06_reads_with_its_defaults() -> None:
    clock = LineClock()
    options, config = ODriveOptions(generation="0.6"), ODriveConfig(generation="0.6", reply_timeout_s=0.2)
    with odrive_bench(clock, options, config) as (axis, _, _):
        assert axis.read().referenced
        axis.home()
        axis.move_to(45.0, 50.0, 100.0)
        clock.sleep(5.0)
        assert axis.read().position_deg == pytest.approx(45.0, abs=0.01)


def test_the_resolution_is_what_float32_leaves_of_the_angle() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        assert axis.limits().resolution_deg == pytest.approx(360e-6)
        device.axes[0].plant.set_zero(clock.now(), 440.0 * 360.0)
        assert axis.limits().resolution_deg == pytest.approx(360.0 * 2.0**-15)
        axis.move_to(441.0 * 360.0, 200.0, 200.0)
        clock.sleep(5.0)
        assert axis.read().position_deg == pytest.approx(441.0 * 360.0, abs=0.02)


def test_modes_and_limits_of_the_controller_are_put_back() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        before = dict(device.axes[0].values)
        axis.home()
        axis.move_to(45.0, 50.0, 100.0)
        clock.sleep(5.0)
        axis.spin(50.0, 100.0)
        axis.arm_watchdog()
        assert axis.safe(AxisSafe.HOLD).verified
        stands_at = device.axes[0].plant.state(clock.now())[0]
        axis.settings.put_back()
        config = {name: value for name, value in before.items() if ".config." in f".{name}"}
        assert {name: device.axes[0].values[name] for name in config} == config
        clock.sleep(60.0)
        assert device.axes[0].plant.state(clock.now())[0] == pytest.approx(stands_at, abs=0.01)
