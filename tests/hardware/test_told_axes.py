"""Axes whose angle nothing reads: a person who says that it stands, and a motor that is told to turn and to stop."""

import math
import time

import pytest
from simulated_devices.line_clock import LineClock
from test_operator import gimbal

from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.drivers.operator import OperatorAxis, OperatorConfig
from gradcal_jax.hardware.drivers.switch import SwitchAxis, SwitchConfig, open_exchange
from gradcal_jax.hardware.errors import LimitExceeded, NotVerified, Rejected
from gradcal_jax.hardware.roles import AxisLimits, AxisSafe
from gradcal_jax.hardware.simulate.lab import SimulatedAxis, SimulatedHand, SimulatedPerson
from gradcal_jax.hardware.simulate.plants import AxisPlant, AxisTruth

TOLD = AxisLimits(300.0, 400.0, None, None, 0.01, hardware_watchdog=False, told=True)


class Motor:
    """The other end of a line: what it is told, and when; it answers with `says`."""

    def __init__(self, says: bytes = b"") -> None:
        self.told: list[tuple[float, str]] = []
        self.says, self.url, self.late = says, "a line", ""

    def write(self, data: bytes) -> None:
        self.told.append((time.monotonic(), data.decode().strip()))

    def read(self, timeout_s: float) -> bytes:
        return self.says

    def drain(self, quiet_s: float = 0.0) -> bytes:
        return b""

    def close(self) -> None: ...


def switched(motor: Motor, **config) -> SwitchAxis:
    options = SwitchConfig(**{"rate_dps": 600.0, "coast_s": 0.05, **config})
    return SwitchAxis(open_exchange(motor, RealClock(), options), options)


def test_a_motor_is_told_to_turn_and_in_time_to_stop():
    motor = Motor()
    axis = switched(motor)
    axis.move_to(180.0, 600.0, 1000.0)
    assert axis.read().moving
    time.sleep(0.5)
    reading = axis.read()
    assert (reading.moving, reading.position_deg) == (False, 180.0)
    axis.move_to(0.0, 600.0, 1000.0)
    time.sleep(0.5)
    words = [word for _, word in motor.told]
    assert words == ["forward", "stop", "backward", "stop"]
    for begin, end in ((0, 1), (2, 3)):
        assert motor.told[end][0] - motor.told[begin][0] == pytest.approx(0.3, abs=0.1)


def test_a_stop_in_between_is_not_followed_by_another():
    motor = Motor()
    axis = switched(motor)
    axis.move_to(300.0, 600.0, 1000.0)
    axis.stop()
    time.sleep(0.7)
    assert [word for _, word in motor.told] == ["forward", "stop"]


def test_what_a_switched_motor_cannot_do_is_refused():
    axis = switched(Motor())
    with pytest.raises(Rejected):
        axis.spin(10.0, 10.0)
    with pytest.raises(LimitExceeded):
        axis.move_to(10.0, 700.0, 10.0)
    assert "unpower" in SwitchConfig().lacks_for("hold")
    assert not SwitchConfig().lacks_for("unpower")


def test_only_a_motor_that_answers_is_known_to_be_safe():
    assert not switched(Motor()).safe(AxisSafe.UNPOWER).verified
    assert switched(Motor(b"ok\r\n"), answer="ok").safe(AxisSafe.UNPOWER).verified
    with pytest.raises(NotVerified, match="did not confirm 'stop'"):
        switched(Motor(b"what?\n"), answer="ok").stop()


def test_a_person_without_a_dial_says_that_it_stands():
    clock = LineClock()
    with gimbal(clock, angle="none") as (axis, person, plant):
        person.options.types_angles = False
        assert not axis.limits().typed
        assert axis.limits().told
        axis.move_to(90.0, 72.0, 14.4)
        end = clock.now() + 600.0
        while (reading := axis.read()).moving:
            assert clock.now() < end
            clock.sleep(0.25)
        # The reading is where it was to go; where it is nobody knows.
        assert reading.position_deg == 90.0
        assert plant.state(clock.now())[0] != 90.0
        assert "press Enter" in person.heard[0]
        assert "no angle" in axis.identify().model


def test_what_is_typed_without_a_dial_is_asked_again():
    clock = LineClock()
    with gimbal(clock, angle="none") as (axis, person, _):
        axis.move_to(90.0, 72.0, 14.4)
        end = clock.now() + 60.0
        while not any("press Enter when" in heard for heard in person.heard):
            assert clock.now() < end
            assert axis.read().moving
            clock.sleep(0.25)


def test_in_a_rehearsal_axes_stop_off_their_goals_and_their_readings_do_not_show_it():
    clock = VirtualClock()
    plants = [AxisPlant(AxisTruth(), clock.now()) for _ in range(2)]
    motor = SimulatedAxis(plants[0], clock, TOLD)
    person = SimulatedPerson(clock, {"hand": plants[1]}, SimulatedHand(3, miss_deg=3.0))
    hand = OperatorAxis(person, OperatorConfig(angle="none"), clock, "hand")
    with clock.party():
        motor.home()
        for axis, plant in ((motor, plants[0]), (hand, plants[1])):
            axis.move_to(90.0, 60.0, 60.0)
            while axis.read().moving:
                clock.sleep(0.5)
            true = plant.state(clock.now())[0]
            assert axis.read().position_deg == pytest.approx(90.0, abs=0.02)
            assert 0.05 < abs(true - 90.0) < 20.0
            assert not math.isnan(true)
