"""Axes whose angle nothing reads: a person who says that it stands, and a motor that is told to turn and to stop."""

import math

import pytest
from test_operator import gimbal

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.drivers.operator import OperatorAxis, OperatorConfig
from gradcal_jax.hardware.roles import AxisLimits
from gradcal_jax.hardware.simulate.lab import SimulatedAxis, SimulatedHand, SimulatedPerson
from gradcal_jax.hardware.simulate.plants import AxisPlant, AxisTruth

TOLD = AxisLimits(300.0, 400.0, None, None, 0.01, told=True)


def test_what_is_typed_without_a_dial_is_asked_again():
    clock = VirtualClock()
    with gimbal(clock, angle="none") as (axis, person, _):
        person.always_types = True
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
