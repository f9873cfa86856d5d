"""Motion and IMU drivers against their simulated peers: behaviour, refusals, faults of the line, gaps."""

import numpy as np
import pytest
from hardware_bench import (
    aerosmith_bench,
    frames_bench,
    grbl_bench,
)
from simulated_devices.faults import Faults
from simulated_devices.line_clock import LineClock

from gradcal_jax.hardware.drivers.lines import LinesConfig
from gradcal_jax.hardware.errors import (
    Disconnected,
    HardwareError,
    LimitExceeded,
    ReplyTimeout,
)
from gradcal_jax.hardware.roles import ImuBatch, ImuStream, MotionAxis, join
from gradcal_jax.hardware.setup import DRIVERS

AXES = {"grbl": grbl_bench, "aerosmith": aerosmith_bench}
QUICK = {
    grbl_bench: LinesConfig(protocol="grbl", reply_timeout="0.05 s", home_timeout="1.0 s"),
    aerosmith_bench: LinesConfig(protocol="aerosmith-like", reply_timeout="0.05 s", home_timeout="10.0 s"),
}


@pytest.fixture(params=AXES)
def axis_bench(request: pytest.FixtureRequest):
    return AXES[request.param]


def wait_until_still(axis: MotionAxis, clock: LineClock) -> float:
    began = clock.now()
    while axis.read().moving:
        clock.sleep(0.05)
    return clock.now() - began


# --- axes -------------------------------------------------------------------------------------------------------------


def test_every_axis_homes_moves_spins_and_stops(axis_bench) -> None:
    clock = LineClock()
    with axis_bench(clock) as (axis, device, _):
        assert isinstance(axis, MotionAxis)
        assert axis.identify().driver in DRIVERS
        axis.home()
        assert axis.read().referenced
        resolution = axis.limits().resolution_deg
        axis.move_to(720.0, 150.0, 300.0)
        assert wait_until_still(axis, clock) == pytest.approx(720 / 150 + 0.5, abs=0.3)
        assert axis.read().position_deg == pytest.approx(720.0, abs=2 * resolution)
        assert device.plant.state(clock.now())[0] == pytest.approx(720.0, abs=2 * resolution)
        axis.move_to(-90.0, 300.0, 300.0)
        wait_until_still(axis, clock)
        assert axis.read().position_deg == pytest.approx(-90.0, abs=2 * resolution)
        # After a move to an angle: the controller's mode must have been changed back for a spin to work.
        axis.spin(-200.0, 250.0)
        clock.sleep(3.0)
        axis.read()
        clock.sleep(5.0)
        reading = axis.read()
        assert reading.moving
        assert reading.rate_dps == pytest.approx(-200.0, rel=1e-3)
        axis.stop()
        assert not axis.read().moving
        report = axis.safe("hold")
        assert report.verified
        assert device.plant.state(clock.now())[1] == 0.0


def test_every_axis_refuses_what_it_cannot_do(axis_bench) -> None:
    with axis_bench(LineClock()) as (axis, device, _):
        axis.identify()
        axis.home()
        for rate, acceleration in ((1000.0, 100.0), (100.0, 1000.0), (100.0, 0.0)):
            with pytest.raises(LimitExceeded, match="accepts"):
                axis.spin(rate, acceleration)
            with pytest.raises(LimitExceeded):
                axis.move_to(10.0, rate, acceleration)
        assert device.plant.state(0.0)[1] == 0.0


@pytest.mark.long
@pytest.mark.parametrize("fault", ["drop", "duplicate", "flip", "delay"])
def test_every_command_of_an_axis_lost_doubled_damaged_or_late_once_is_noticed(axis_bench, fault) -> None:
    """Each line of a session in its turn: what returns without an exception has taken effect."""
    # Of a board's session of two hundred lines every seventh is enough here.
    refused = tried = 0
    for number in range(0, 60, 7):
        clock, faults = LineClock(), Faults(seed=number, delay_s=0.08)
        with axis_bench(clock, config=QUICK[axis_bench], commands=faults) as (axis, device, _):
            faults.once(*["split"] * number, fault)
            tried += 1
            try:
                axis.identify()
                axis.home()
                axis.move_to(40.0, 100.0, 200.0)
                wait_until_still(axis, clock)
                assert device.plant.state(clock.now())[0] == pytest.approx(40.0, abs=0.01)
                axis.spin(-50.0, 200.0)
                clock.sleep(3.0)
                assert device.plant.state(clock.now())[1] == pytest.approx(-50.0, rel=1e-3)
                axis.stop()
                assert device.plant.state(clock.now())[1] == 0.0
                axis.move_to(10.0, 100.0, 200.0)
                wait_until_still(axis, clock)
                assert device.plant.state(clock.now())[0] == pytest.approx(10.0, abs=0.01)
            except HardwareError:
                refused += 1
            assert axis.safe("hold").verified
            assert device.plant.state(clock.now())[1] == 0.0
    # A damaged line that the device itself refuses is said, too.
    assert refused <= (tried if fault == "flip" else tried // 4)


@pytest.mark.long
@pytest.mark.parametrize("way", ["faults", "commands"])
def test_no_axis_is_put_off_by_a_bad_line(axis_bench, way: str) -> None:
    """Replies or commands dropped, flipped, doubled, cut: what the driver says it did, it did."""
    clock = LineClock()
    kinds = ("drop", "flip", "truncate", "duplicate", "split", "noise")
    faults = Faults(seed=8, probability=dict.fromkeys(kinds, 0.04 if way == "faults" else 0.02))
    with axis_bench(clock, config=QUICK[axis_bench], **{way: faults}) as (axis, device, _):
        done = 0
        for attempt in range(40):
            try:
                axis.identify()
                axis.home()
                break
            except HardwareError:
                assert attempt < 39
        for index in range(5):
            target = 30.0 * (index + 1)
            try:
                axis.move_to(target, 100.0, 200.0)
                wait_until_still(axis, clock)
            except HardwareError:
                clock.sleep(20.0)
                continue
            done += 1
            assert device.plant.state(clock.now())[0] == pytest.approx(target, abs=0.01)
        assert done >= 2
        assert sum(faults.count.values()) > 10


# --- IMUs -------------------------------------------------------------------------------------------------------------


def stream(unit: ImuStream, clock: LineClock, duration_s: float) -> ImuBatch:
    decoder = unit.decoder()
    unit.start()
    end = clock.now() + duration_s
    batches = []
    while clock.now() < end:
        with clock.aside():
            batches.append(decoder.push(*unit.read_bytes(0.5)))
    return join(batches)


def test_every_imu_streams_configured_samples_without_a_gap() -> None:
    clock = LineClock()
    with frames_bench(clock) as (unit, _, port):
        clock.sleep(1.5)
        assert isinstance(unit, ImuStream)
        identity = unit.identify()
        assert identity.model == "STIM300"
        settings = unit.configure()
        samples = stream(unit, clock, 4.0)
        assert len(samples) == pytest.approx(4.0 * settings.sample_rate_hz, rel=0.05)
        assert np.all(samples.gap_before[1:] == 0)
        np.testing.assert_allclose(np.diff(samples.device_time_s), 1.0 / settings.sample_rate_hz, rtol=1e-6)
        np.testing.assert_allclose(samples.acceleration_g[-1], [0.0, 0.0, 1.0], atol=1e-5)
        np.testing.assert_allclose(samples.temperature_c[-1], 23.0, atol=0.01)
        unit.stop()
        assert port.lost_bytes == 0


def test_damaged_datagrams_are_counted_as_gaps_and_never_decoded() -> None:
    clock = LineClock()
    faults = Faults(seed=2)
    with frames_bench(clock, faults=faults) as (unit, _, _):
        unit.configure()
        faults.probability = {"flip": 0.02, "drop": 0.02, "truncate": 0.02, "noise": 0.02}
        samples = stream(unit, clock, 8.0)
        assert sum(faults.count.values()) > 20
        assert np.all(np.abs(samples.gyro_dps) < 0.01)
        np.testing.assert_allclose(samples.temperature_c, 23.0, atol=0.01)
        lost = int(samples.gap_before[1:].sum())
        assert lost >= faults.count["drop"] + faults.count["flip"] - 2
        spanned = (samples.device_time_s[-1] - samples.device_time_s[0]) * 125.0
        assert len(samples) + lost == round(spanned) + 1


def read_for_ever(unit: ImuStream) -> None:
    while True:
        unit.read_bytes(0.1)


def test_unplugged_imu_raises() -> None:
    clock = LineClock()
    with frames_bench(clock) as (unit, _, port):
        unit.configure()
        unit.start()
        port.unplug()
        with pytest.raises(Disconnected):
            read_for_ever(unit)


def test_transport_is_named_in_every_message_about_silence() -> None:
    clock = LineClock()
    with aerosmith_bench(clock) as (axis, _, port):
        port.faults = Faults(mute=True)
        with pytest.raises(ReplyTimeout) as caught:
            axis.read()
        assert port.url in str(caught.value)
        assert "MCO5" in str(caught.value)
