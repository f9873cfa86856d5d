"""Motion and IMU drivers against their simulated peers: behaviour, refusals, faults of the line, watchdog, gaps.

The vendor's old client zaber.serial, which shares nothing with this package, checks the simulated stage.
"""

from typing import Any

import numpy as np
import pytest
import zaber.serial
from hardware_bench import (
    aerosmith_bench,
    grbl_bench,
    odrive_bench,
    sensor_on_table,
    served,
    stim300_bench,
    vectornav_bench,
    zaber_bench,
)
from simulated_devices.faults import Faults
from simulated_devices.limited_axis import LimitedAxis
from simulated_devices.line_clock import LineClock
from simulated_devices.odrive import ODriveOptions, SimulatedODrive
from simulated_devices.port import SimulatedPort
from simulated_devices.stim300 import SimulatedStim300, Stim300Options
from simulated_devices.zaber import SimulatedZaber, ZaberOptions

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.drivers import odrive
from gradcal_jax.hardware.drivers.lines import LinesConfig
from gradcal_jax.hardware.drivers.odrive import ODriveConfig
from gradcal_jax.hardware.drivers.stim300 import START_UP, Stim300Config, Stim300Stream
from gradcal_jax.hardware.drivers.vectornav import VectorNavConfig
from gradcal_jax.hardware.drivers.zaber import ZaberConfig
from gradcal_jax.hardware.errors import (
    DeviceFault,
    Disconnected,
    FramingError,
    HardwareError,
    LimitExceeded,
    NotVerified,
    Rejected,
    ReplyTimeout,
)
from gradcal_jax.hardware.roles import AxisSafe, ImuBatch, ImuStream, MotionAxis, join
from gradcal_jax.hardware.setup import DRIVERS
from gradcal_jax.hardware.simulate.plants import AxisPlant

AXES = {"zaber": zaber_bench, "odrive": odrive_bench, "grbl": grbl_bench, "aerosmith": aerosmith_bench}
QUICK = {
    zaber_bench: ZaberConfig(reply_timeout_s=0.05),
    odrive_bench: ODriveConfig(reply_timeout_s=0.05),
    grbl_bench: LinesConfig(protocol="grbl", reply_timeout_s=0.05, home_timeout_s=1.0),
    aerosmith_bench: LinesConfig(protocol="aerosmith-like", reply_timeout_s=0.05, home_timeout_s=10.0),
}
UNCHECKED = (grbl_bench, aerosmith_bench)
IMUS = {"stim300": stim300_bench, "vectornav": vectornav_bench}


@pytest.fixture(params=AXES)
def axis_bench(request: pytest.FixtureRequest):
    return AXES[request.param]


@pytest.fixture(params=IMUS)
def imu_bench(request: pytest.FixtureRequest):
    return IMUS[request.param]


def wait_until_still(axis: MotionAxis, clock: LineClock) -> float:
    began = clock.now()
    while axis.read().moving:
        clock.sleep(0.05)
    return clock.now() - began


def plant_of(device: Any) -> AxisPlant:
    if isinstance(device, (SimulatedZaber, SimulatedODrive)):
        return device.stages[0].plant if isinstance(device, SimulatedZaber) else device.axes[0].plant
    return device.plant


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
        assert plant_of(device).state(clock.now())[0] == pytest.approx(720.0, abs=2 * resolution)
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
        report = axis.safe(AxisSafe.HOLD)
        assert report.verified
        assert plant_of(device).state(clock.now())[1] == 0.0


def test_every_axis_refuses_what_it_cannot_do(axis_bench) -> None:
    with axis_bench(LineClock()) as (axis, device, _):
        axis.identify()
        axis.home()
        for rate, acceleration in ((1000.0, 100.0), (100.0, 1000.0), (100.0, 0.0)):
            with pytest.raises(LimitExceeded, match="outside"):
                axis.spin(rate, acceleration)
            with pytest.raises(LimitExceeded):
                axis.move_to(10.0, rate, acceleration)
        assert plant_of(device).state(0.0)[1] == 0.0


@pytest.mark.long
@pytest.mark.parametrize("fault", ["drop", "duplicate", "flip", "delay"])
def test_every_command_of_an_axis_lost_doubled_damaged_or_late_once_is_noticed(axis_bench, fault) -> None:
    """Each line of a session in its turn: what returns without an exception has taken effect."""
    # A stage answers every line; of a board's session of two hundred lines every seventh is enough here.
    step = 11 if axis_bench is odrive_bench else 7
    refused = tried = 0
    for number in range(0, 100 if axis_bench is odrive_bench else 60, step):
        clock, faults = LineClock(), Faults(seed=number, delay_s=0.08)
        with axis_bench(clock, config=QUICK[axis_bench], commands=faults) as (axis, device, _):
            faults.once(*["split"] * number, fault)
            tried += 1
            try:
                axis.identify()
                axis.home()
                axis.move_to(40.0, 100.0, 200.0)
                wait_until_still(axis, clock)
                assert plant_of(device).state(clock.now())[0] == pytest.approx(40.0, abs=0.01)
                axis.spin(-50.0, 200.0)
                clock.sleep(3.0)
                assert plant_of(device).state(clock.now())[1] == pytest.approx(-50.0, rel=1e-3)
                axis.stop()
                assert plant_of(device).state(clock.now())[1] == 0.0
                axis.move_to(10.0, 100.0, 200.0)
                wait_until_still(axis, clock)
                assert plant_of(device).state(clock.now())[0] == pytest.approx(10.0, abs=0.01)
            except HardwareError:
                refused += 1
            assert axis.safe(AxisSafe.HOLD).verified
            assert plant_of(device).state(clock.now())[1] == 0.0
    # A damaged line that the device itself refuses is said, too.
    assert refused <= (tried if fault == "flip" and axis_bench in UNCHECKED else tried // 4)


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
            assert plant_of(device).state(clock.now())[0] == pytest.approx(target, abs=0.01)
        assert done >= 2
        assert sum(faults.count.values()) > 10


def test_two_axes_share_a_port_and_stay_apart() -> None:
    clock = LineClock()
    plants = [AxisPlant(), AxisPlant()]
    with served(SimulatedODrive(plants, clock), clock, 115200) as (_, line):
        exchange = odrive.open_exchange(line, clock, ODriveConfig())
        outer, inner = (odrive.ODriveAxis(exchange, ODriveConfig(motor=motor)) for motor in (0, 1))
        inner.move_to(45.0, 100.0, 100.0)
        outer.spin(-10.0, 100.0)
        clock.sleep(10.0)
        assert inner.read().position_deg == pytest.approx(45.0, abs=0.001)
        assert outer.read().rate_dps == pytest.approx(-10.0, rel=1e-3)
        inner.stop()
        assert outer.read().moving
        assert plants[1].state(clock.now())[1] == 0.0


# --- Zaber ------------------------------------------------------------------------------------------------------------


def test_simulated_stage_satisfies_the_vendors_client() -> None:
    clock = RealClock()
    plant = AxisPlant(None, clock.now())
    device = SimulatedZaber([plant], clock, ZaberOptions(home_rate_dps=1e4))
    with SimulatedPort(device, clock) as port:
        client = zaber.serial.AsciiSerial(port.url, timeout=2)
        stage = zaber.serial.AsciiDevice(client, 1)
        assert stage.home().reply_flag == "OK"
        device.stages[0].settings["maxspeed"] = device.stages[0].settings["accel"] = 10**9
        assert stage.move_abs(1152000 // 4).reply_flag == "OK"
        assert stage.get_position() == 1152000 // 4
        assert plant.state(clock.now())[0] == pytest.approx(90.0)
        assert stage.send("no such thing").data == "BADCOMMAND"
        stage.send("set comm.checksum 1")
        assert stage.send("get pos").checksum is not None
        stage.move_vel(100000)
        assert stage.get_status() == "BUSY"
        stage.stop()
        assert stage.get_status() == "IDLE"
        client.close()


def test_stage_with_chatter_check_sums_and_settings_for_a_run() -> None:
    clock = LineClock()
    with zaber_bench(clock, ZaberOptions(chatter=True)) as (axis, device, port):
        assert axis.identify().details["replies"] == "with checksum"
        assert axis.reply_checksum
        assert device.stages[0].settings["knob.enable"] == 0
        assert device.stages[0].settings["comm.alert"] == 0
        port.say(b"!01 1 IDLE --\r\n#01 0 hello\r\n")
        axis.home()
        axis.move_to(10.0, 50.0, 50.0)


@pytest.mark.parametrize("firmware", [6, 7])
def test_stage_of_either_firmware_and_its_settings_put_back(firmware: int) -> None:
    clock = LineClock()
    with zaber_bench(clock, ZaberOptions(firmware=firmware)) as (axis, device, _):
        before = dict(device.stages[0].settings)
        assert axis.identify().model == "device 50081"
        axis.home()
        axis.move_to(30.0, 50.0, 90.0)
        wait_until_still(axis, clock)
        assert device.stages[0].settings != before
        axis.settings.put_back()
        assert device.stages[0].settings == before
        assert axis.read().position_deg == pytest.approx(30.0, abs=0.001)


def test_vectornav_outputs_of_an_earlier_use_are_silent_and_put_back() -> None:
    clock = LineClock()
    with vectornav_bench(clock) as (unit, device, _):
        device.registers |= {6: "14", 76: "1,2,01,0008", 77: "2,2,01,0008"}
        before = dict(device.registers)
        unit.configure()
        decoder = unit.decoder()
        unit.start()
        end = clock.now() + 2.0
        batches = []
        while clock.now() < end:
            with clock.aside():
                batches.append(decoder.push(*unit.read_bytes(0.5)))
        assert len(join(batches)) == pytest.approx(400, rel=0.05)
        assert (device.registers[76][:2], device.registers[77][:2]) == ("0,", "0,")
        unit.settings.put_back()
        assert device.registers == before


def test_stage_without_reference_or_with_a_fault_does_not_move() -> None:
    clock = LineClock()
    with zaber_bench(clock) as (axis, device, _):
        axis.identify()
        with pytest.raises(DeviceFault, match="Home it first"):
            axis.move_to(10.0, 50.0, 50.0)
        axis.home()
        axis.spin(50.0, 50.0)
        clock.sleep(5.0)
        device.fault("FS")
        assert axis.read().faults == ("FS (stalled and stopped)",)
        with pytest.raises(DeviceFault, match="FS"):
            axis.stop()
        assert axis.safe(AxisSafe.HOLD).verified
        device.fault("FH")
        with pytest.raises(Rejected, match="FH"):
            axis.spin(50.0, 50.0)
        with pytest.raises(Rejected, match="unpower_command"):
            axis.safe(AxisSafe.UNPOWER)


def test_stage_that_does_not_tell_its_microsteps_needs_them_from_the_rig_file() -> None:
    options = ZaberOptions(tells_cycle=False, microsteps_per_turn=230400)
    with zaber_bench(LineClock(), options) as (axis, _, _), pytest.raises(Rejected, match="microsteps_per_turn"):
        axis.identify()
    clock = LineClock()
    config = ZaberConfig(microsteps_per_turn=230400, direction=-1, zero_deg=5.0)
    with zaber_bench(clock, options, config) as (axis, device, _):
        axis.identify()
        axis.home()
        axis.move_to(95.0, 50.0, 100.0)
        wait_until_still(axis, clock)
        assert axis.read().position_deg == pytest.approx(95.0, abs=0.002)
        assert device.stages[0].plant.state(clock.now())[0] == pytest.approx(-90.0, abs=0.002)


def test_stage_with_limited_travel() -> None:
    clock = LineClock()
    plant = LimitedAxis((0.0, 360.0), clock.now())
    with zaber_bench(clock, ZaberOptions(endless=False), plant=plant) as (axis, _, _):
        axis.identify()
        axis.home()
        assert (axis.limits().lowest_deg, axis.limits().highest_deg) == (0.0, 360.0)
        with pytest.raises(LimitExceeded, match="travel"):
            axis.move_to(361.0, 50.0, 100.0)
        axis.spin(100.0, 100.0)
        clock.sleep(60.0)
        assert axis.read().faults == ("FE (limit error)",)


# --- ODrive -----------------------------------------------------------------------------------------------------------


def test_watchdog_stops_the_motor_when_the_host_falls_silent_and_not_before() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.spin(90.0, 300.0)
        axis.arm_watchdog()
        for _ in range(40):
            clock.sleep(0.25)
            axis.heartbeat()
        assert axis.read().faults == ()
        clock.sleep(30.0)
        assert device.axes[0].plant.state(clock.now())[1] == 0.0
        assert axis.read().faults == ("0x800 (watchdog expired)",)
        with pytest.raises(DeviceFault, match="watchdog"):
            axis.spin(90.0, 300.0)


def test_safe_hold_leaves_the_motor_powered_after_the_host_is_gone() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.spin(90.0, 300.0)
        axis.arm_watchdog()
        assert axis.safe(AxisSafe.HOLD).verified
        clock.sleep(3600.0)
        assert device.axes[0].state == odrive.CLOSED_LOOP
        assert axis.safe(AxisSafe.UNPOWER).verified
        assert device.axes[0].state == odrive.IDLE


def test_odrive_lost_encoder_is_never_a_position_of_zero() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.move_to(100.0, 100.0, 100.0)
        wait_until_still(axis, clock)
        device.lose_encoder()
        reading = axis.read()
        assert reading.position_deg == 0.0
        assert not reading.referenced
        assert "the encoder's position is not valid" in reading.faults


def test_odrive_lost_command_is_sent_again_and_a_reboot_is_noticed() -> None:
    clock = LineClock()
    with odrive_bench(clock) as (axis, device, _):
        axis.spin(30.0, 100.0)
        receive, swallowed = device.receive, []

        def once_deaf(data: bytes) -> list[bytes]:
            if data.startswith(b"v ") and not swallowed:
                swallowed.append(data)
                data = data.replace(b"v", b"w", 1)  # one damaged character: the line vanishes
            return receive(data)

        device.receive = once_deaf
        axis.spin(60.0, 100.0)
        clock.sleep(3.0)
        assert (len(swallowed), device.vanished_lines) == (1, 1)
        assert axis.read().rate_dps == pytest.approx(60.0, rel=1e-3)
        device.reboot()
        clock.sleep(10.0)
        # It had been powered by this program: held is held, also after a reboot.
        assert axis.safe(AxisSafe.HOLD).evidence.startswith("0.000 deg/s")
        assert device.axes[0].state == odrive.CLOSED_LOOP


def test_odrive_of_generation_06_with_gear() -> None:
    clock = LineClock()
    options = ODriveOptions(generation="0.6", turns_per_table_turn=10.0, max_turns_per_s=20.0)
    config = ODriveConfig(generation="0.6", turns_per_table_turn=10.0, ready_property="", reply_timeout_s=0.2)
    with odrive_bench(clock, options, config) as (axis, device, _):
        axis.move_to(36.0, 50.0, 50.0)
        wait_until_still(axis, clock)
        assert axis.read().position_deg == pytest.approx(36.0, abs=1e-3)
        device.fault(0x02000000)
        assert axis.read().faults == ("0x2000000 (emergency stop)",)


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


def test_every_imu_streams_configured_samples_without_a_gap(imu_bench) -> None:
    clock = LineClock()
    with imu_bench(clock) as (unit, _, port):
        assert isinstance(unit, ImuStream)
        identity = unit.identify()
        assert identity.serial_number
        settings = unit.configure()
        samples = stream(unit, clock, 4.0)
        assert len(samples) == pytest.approx(4.0 * settings.sample_rate_hz, rel=0.05)
        assert np.all(samples.gap_before[1:] == 0)
        np.testing.assert_allclose(np.diff(samples.device_time_s), 1.0 / settings.sample_rate_hz, rtol=1e-6)
        np.testing.assert_allclose(samples.acceleration_g[-1], [0.0, 0.0, 1.0], atol=1e-5)
        np.testing.assert_allclose(samples.temperature_c[-1], 23.0, atol=0.01)
        unit.stop()
        assert unit.identify() == identity  # questions work again between two streams
        assert port.lost_bytes == 0


def test_damaged_datagrams_are_counted_as_gaps_and_never_decoded(imu_bench) -> None:
    clock = LineClock()
    faults = Faults(seed=2)
    with imu_bench(clock, faults=faults) as (unit, device, _):
        unit.configure()
        faults.probability = {"flip": 0.02, "drop": 0.02, "truncate": 0.02, "noise": 0.02}
        samples = stream(unit, clock, 8.0)
        assert sum(faults.count.values()) > 20
        assert np.all(np.abs(samples.gyro_dps) < 0.01)
        np.testing.assert_allclose(samples.temperature_c, 23.0, atol=0.01)
        lost = int(samples.gap_before[1:].sum())
        assert lost >= faults.count["drop"] + faults.count["flip"] - 2
        rate_hz = 125.0 if isinstance(device, SimulatedStim300) else 200.0
        spanned = (samples.device_time_s[-1] - samples.device_time_s[0]) * rate_hz
        assert len(samples) + lost == round(spanned) + 1


@pytest.mark.parametrize("fault", ["drop", "duplicate", "flip"])
def test_a_command_of_an_imu_lost_doubled_or_damaged_once_is_noticed(imu_bench, fault) -> None:
    refused = 0
    for number in range(1, 22, 4):
        clock, faults = LineClock(), Faults(seed=number)
        with imu_bench(clock, commands=faults) as (unit, _, _):
            faults.once(*["split"] * number, fault)
            try:
                unit.identify()
                settings = unit.configure()
                samples = stream(unit, clock, 1.0)
            except HardwareError:
                refused += 1
                continue
            assert len(samples) == pytest.approx(settings.sample_rate_hz, rel=0.2)
            assert np.all(samples.gap_before[1:] == 0)
    assert refused <= (6 if fault == "flip" else 2)  # of a damaged line the unit itself says that it is


def read_for_ever(unit: ImuStream) -> None:
    while True:
        unit.read_bytes(0.1)


def test_unplugged_imu_raises(imu_bench) -> None:
    clock = LineClock()
    with imu_bench(clock) as (unit, _, port):
        unit.configure()
        unit.start()
        port.unplug()
        with pytest.raises(Disconnected):
            read_for_ever(unit)


def test_stim300_start_up_special_datagrams_and_reboot() -> None:
    clock = LineClock()
    with stim300_bench(clock) as (unit, device, _):
        unit.configure()
        decoder = unit.decoder()
        unit.start()
        already = device.counters["special"]
        device.reboot()
        device._registers["im"], device._registers["id"] = "0", "5"
        device._restart()
        batches = []
        while clock.now() < 3.0:
            with clock.aside():
                batches.append(decoder.push(*unit.read_bytes(0.5)))
        samples = join(batches)
        assert device.counters["special"] - already == 3
        starting = (samples.status & START_UP) != 0
        assert 80 < int(starting.sum()) < 130
        assert not starting[-1]


def test_stim300_settings_are_read_back_and_never_saved() -> None:
    clock = LineClock()
    config = Stim300Config(sample_rate_hz=500.0, datagram=7, increments=True, reply_timeout_s=0.3)
    sensor = sensor_on_table(clock)
    with stim300_bench(clock, Stim300Options(range_g=30), config, sensor) as (unit, device, _):
        settings = unit.configure()
        assert settings.registers["im"] == "2"
        assert settings.registers["id"] == "7"
        assert settings.registers["isv"] == "9958"
        samples = stream(unit, clock, 1.0)
        np.testing.assert_allclose(samples.acceleration_g[-1], [0.0, 0.0, 1.0], atol=1e-3)
        assert len(samples) == pytest.approx(500, rel=0.05)
        assert device.counters["overrun"] == 0


def test_stim300_on_a_line_that_is_too_slow_loses_datagrams_and_the_host_sees_it() -> None:
    clock = LineClock()
    options = Stim300Options(baudrate=40_000)
    with stim300_bench(clock, options) as (unit, device, _):
        unit.configure()
        already = device.counters["overrun"]
        samples = stream(unit, clock, 4.0)
        lost = device.counters["overrun"] - already
        assert lost > 50
        assert samples.gap_before[1:].sum() == pytest.approx(lost, abs=8)


def test_stim300_port_that_is_something_else() -> None:
    clock = LineClock()
    config = Stim300Config(mode_timeout_s=0.2)
    with served(SimulatedZaber([AxisPlant()], clock), clock, 921600) as (_, line), pytest.raises(ReplyTimeout):
        Stim300Stream(line, clock, config).identify()

    class Talker:
        def receive(self, data: bytes) -> list[bytes]:
            return [b"@01 0 RJ IDLE -- BADCOMMAND\r\n"]

    with served(Talker(), clock, 921600) as (_, line), pytest.raises(FramingError, match="BADCOMMAND"):
        Stim300Stream(line, clock, config).identify()


def test_vectornav_on_a_line_too_slow() -> None:
    with vectornav_bench(LineClock()) as (unit, device, _):
        unit.configure()
        device.registers[5] = "9600"
        with pytest.raises(Rejected, match="baud rate too low"):
            unit.start()
    with pytest.raises(ValueError, match="do not fit"):
        VectorNavConfig(sample_rate_hz=800.0, baudrate=115200)
    with pytest.raises(ValueError, match="does not divide"):
        VectorNavConfig(sample_rate_hz=300.0)


def test_vectornav_register_that_does_not_take_is_noticed() -> None:
    with vectornav_bench(LineClock()) as (unit, device, _):
        unit.configure()
        device._write_binary = lambda fields: 0  # it says yes and keeps its old output
        with pytest.raises(NotVerified, match="Register 75"):
            unit.start()


def test_transport_is_named_in_every_message_about_silence() -> None:
    clock = LineClock()
    with zaber_bench(clock) as (axis, _, port):
        port.faults = Faults(mute=True)
        with pytest.raises(ReplyTimeout) as caught:
            axis.read()
        assert port.url in str(caught.value)
        assert "get pos" in str(caught.value)
