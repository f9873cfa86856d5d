"""A Weiss chamber whose commands are lost on the wire: a ramp counts only when the nominal value moves as it should."""

import re
from collections.abc import Callable

import pytest
from hardware_bench import weiss_bench
from simulated_devices.line_clock import LineClock
from simulated_devices.weiss import SimulatedWeiss, WeissOptions

from gradcal_jax.hardware.drivers.weiss import WeissConfig, parse_description
from gradcal_jax.hardware.errors import NotVerified
from gradcal_jax.hardware.roles import ChamberSafe, TemperatureChamber

CONFIG = WeissConfig(reply_timeout_s=0.3, acknowledge_timeout_s=0.1, description_silence_s=0.1, product_channel="MV01")


def harmed(device: SimulatedWeiss, letter: str, change: Callable[[bytes], bytes], *, times: int = 1) -> list[bytes]:
    """From now on the first commands of a letter arrive changed; what was sent is returned as it comes."""
    receive, hit = device.receive, []

    def deaf(data: bytes) -> list[bytes]:
        if data.startswith(b"$01" + letter.encode()) and len(hit) < times:
            hit.append(data)
            data = change(data)
        return receive(data)

    device.receive = deaf
    return hit


def slope_k_per_min(chamber: TemperatureChamber, clock: LineClock) -> float:
    clock.sleep(60.0)
    before = chamber.read()
    clock.sleep(300.0)
    after = chamber.read()
    return (after.setpoint_c - before.setpoint_c) / (after.time_s - before.time_s) * 60.0


@pytest.mark.parametrize("acknowledges", [True, False])
@pytest.mark.parametrize(
    ("letter", "change"),
    [
        ("U", lambda data: b""),
        ("E", lambda data: b""),
        ("U", lambda data: data.replace(b"0001.0", b"0003.0")),
        ("U", lambda data: data.replace(b"0001.0", b"0000.0")),
    ],
    ids=["lost gradient", "lost set point", "damaged gradient", "no gradient"],
)
@pytest.mark.parametrize(("target_c", "runs"), [(60.0, True), (-20.0, False)])
def test_a_ramp_whose_commands_do_not_arrive_is_told_again(
    acknowledges: bool, letter: str, change: Callable[[bytes], bytes], target_c: float, runs: bool
) -> None:
    clock = LineClock()
    with weiss_bench(clock, WeissOptions(acknowledges=acknowledges, strict=True), CONFIG) as (chamber, device, _):
        chamber.hold(24.0)
        clock.sleep(1800.0)
        if not runs:
            chamber.standby()
        hit = harmed(device, letter, change)
        chamber.ramp(target_c, 1.0)
        assert len(hit) == 1
        assert abs(device.plant.air_c(clock.now()) - 24.0) < 2.0
        assert slope_k_per_min(chamber, clock) == pytest.approx(1.0 if target_c > 24.0 else -1.0, abs=0.05)
        assert device.throttle_violations == 0


def test_a_chamber_that_takes_no_ramp_is_a_sentence() -> None:
    clock = LineClock()
    with weiss_bench(clock, config=CONFIG) as (chamber, device, _):
        chamber.hold(24.0)
        harmed(device, "U", lambda data: re.sub(rb"\d{4}\.\d", b"0000.0", data), times=100)
        with pytest.raises(NotVerified, match=r"commanded 3 times: its nominal value moved 36\.0 K"):
            chamber.ramp(60.0, 1.0)


def test_a_lost_end_of_a_gradient_does_not_slow_the_hold_that_follows() -> None:
    clock = LineClock()
    with weiss_bench(clock, WeissOptions(acknowledges=False), CONFIG) as (chamber, device, _):
        chamber.hold(24.0)
        chamber.ramp(60.0, 1.0)
        hit = harmed(device, "U", lambda data: b"")
        chamber.hold(30.0)
        assert len(hit) == 1
        assert device.plant.set_point_c(clock.now()) == 30.0


@pytest.mark.parametrize("acknowledges", [True, False])
@pytest.mark.parametrize("policy", list(ChamberSafe))
def test_safe_takes_the_gradient_off(policy: ChamberSafe, acknowledges: bool) -> None:
    clock = LineClock()
    with weiss_bench(clock, WeissOptions(acknowledges=acknowledges), CONFIG) as (chamber, device, _):
        chamber.ramp(60.0, 1.0)
        assert device.gradients == (1.0, 0.0)
        harmed(device, "U", lambda data: b"")
        assert chamber.safe(policy).verified
        assert device.gradients == (0.0, 0.0)


def test_a_description_in_capital_letters_is_understood() -> None:
    clock = LineClock()
    with weiss_bench(clock, config=CONFIG) as (_, device, _):
        text = device._description()
        shouted = text.replace("E-String", "E-STRING").replace("I-String", "I-STRING").replace("value min", "VALUE MIN")
        assert parse_description(shouted.replace("value max", "VALUE MAX")) == parse_description(text)
