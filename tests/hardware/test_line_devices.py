"""Chambers and axes by their descriptions, against simulated peers: behaviour, refusals, spoilt lines, late replies."""

import pytest
from hardware_bench import (
    aerosmith_bench,
    cts_bench,
    espec_bench,
    espec_config,
    f4t_bench,
    grbl_bench,
    lines_config,
)
from simulated_devices.faults import Faults

from gradcal_jax.hardware.errors import (
    DeviceFault,
    Disconnected,
    HardwareError,
    LimitExceeded,
    NotVerified,
    Rejected,
    ReplyTimeout,
)

CHAMBERS = {"lines": espec_bench, "frames with a check": cts_bench, "registers": f4t_bench}
AXES = {"lines that end": grbl_bench, "a prompt": aerosmith_bench}
of_chambers = pytest.mark.parametrize("bench", CHAMBERS.values(), ids=CHAMBERS)
of_axes = pytest.mark.parametrize("bench", AXES.values(), ids=AXES)


def set_point(device, clock):
    return device.plant.at(clock.now()).set_point_c


def rate_dps(device, clock):
    return device.plant.state(clock.now())[1]


def come_to_rest(axis, clock):
    began = clock.now()
    while axis.read().moving:
        clock.sleep(0.05)
    return clock.now() - began


def use_chamber(chamber, device, clock, number):
    """What returns without an exception has taken effect."""
    target = 20.0 + number
    chamber.hold(target)
    assert set_point(device, clock) == pytest.approx(target, abs=1e-3)
    assert device.plant.conditioning
    if chamber.limits().hardware_ramp:
        clock.sleep(1800.0)
        chamber.ramp(target + 20.0, 1.0)
        began_s, began_c = clock.now(), set_point(device, clock)
        clock.sleep(300.0)
        rate = (set_point(device, clock) - began_c) / (clock.now() - began_s) * 60.0
        assert rate == pytest.approx(1.0, abs=0.25)
    chamber.standby()
    assert not device.plant.conditioning


def use_axis(axis, device, clock, number):
    axis.identify()
    axis.home()
    axis.move_to(40.0 + number, 100.0, 200.0)
    come_to_rest(axis, clock)
    assert device.plant.state(clock.now())[0] == pytest.approx(40.0 + number, abs=0.01)
    axis.spin(-50.0, 200.0)
    clock.sleep(3.0)
    assert rate_dps(device, clock) == pytest.approx(-50.0, rel=1e-3)
    axis.stop()
    assert rate_dps(device, clock) == 0.0


# ----------------------------------------------------------------------------------------------------------- chambers


@of_chambers
def test_every_chamber_holds_settles_and_goes_safe(bench):
    with bench() as (chamber, device, port, clock):
        limits = chamber.limits()
        assert not chamber.read().conditioning
        use_chamber(chamber, device, clock, 0)
        chamber.hold(-30.0)
        assert (chamber.read().setpoint_c, chamber.read().conditioning) == (-30.0, True)
        clock.sleep(5400.0)
        settled = chamber.read()
        assert settled.air_c == pytest.approx(-30.0, abs=0.05)
        assert settled.alarms == ()
        for wrong in (limits.highest_c + 1.0, limits.lowest_c - 1.0):
            with pytest.raises(LimitExceeded, match="accepts"):
                chamber.hold(wrong)
        for policy, air in (("hold", -30.0), ("ambient", 23.0)):
            assert chamber.safe(policy, 23.0).verified
            clock.sleep(7200.0)
            assert chamber.read().air_c == pytest.approx(air, abs=0.1)
        # Of a room that the chamber's limits leave out, as near as they allow.
        assert chamber.safe("ambient", 500.0).verified
        assert chamber.read().setpoint_c == limits.highest_c
        assert chamber.safe("standby").verified
        assert not chamber.read().conditioning
        chamber.hold(50.0)
        device.reboot()
        assert not chamber.read().conditioning
        assert port.lost_bytes == 0


@of_chambers
def test_a_silent_chamber_and_a_pulled_cable_are_told_apart(bench):
    with bench() as (chamber, _, port, _):
        port.faults = Faults(mute=True)
        with pytest.raises(ReplyTimeout, match=f"{port.url} was sent .*did not answer"):
            chamber.read()
        port.faults = None
        chamber.read()
        port.unplug()
        with pytest.raises(Disconnected, match="cable"):
            chamber.read()


def test_the_slope_that_a_device_shows_is_told_wherever_its_reply_has_it():
    reply = "R1 {state:char}{:char} {up} {down} {target}"
    with cts_bench(lines_config("cts", changes={"ask": {"ramp": {"reply": reply}}})) as (chamber, *_):
        assert chamber.ramp(60.0, 1.5) == pytest.approx(1.5, abs=0.01)


@pytest.mark.parametrize("bench", [cts_bench, f4t_bench])
def test_ramps_in_the_controller_have_the_rate_that_was_asked_for(bench):
    with bench() as (chamber, device, _, clock):
        chamber.hold(-20.0)
        clock.sleep(5400.0)
        # The second from within the first, downwards.
        for goal, rate in ((40.0, 1.0), (-10.0, -0.5)):
            assert chamber.ramp(goal, abs(rate)) == pytest.approx(abs(rate), abs=0.01)
            clock.sleep(600.0)
            first, first_c = chamber.read(), set_point(device, clock)
            clock.sleep(600.0)
            second, second_c = chamber.read(), set_point(device, clock)
            lasted_min = (second.time_s - first.time_s) / 60.0
            assert (second_c - first_c) / lasted_min == pytest.approx(rate, abs=0.02)
            assert (second.air_c - first.air_c) / lasted_min == pytest.approx(rate, abs=0.02)
        chamber.hold(-40.0)
        assert chamber.read().setpoint_c == -40.0
        chamber.ramp(60.0, 1.0)
        assert chamber.safe("standby").verified
        # Of a ramp nothing stays in the controller.
        assert getattr(device, "up", 999.9) == getattr(device, "down", 999.9) == 999.9


def test_a_program_at_the_panel_ends_with_a_set_point_and_alarms_are_read():
    with espec_bench() as (chamber, device, _, clock):
        assert chamber.identify().model == "ESPEC P300"
        device.run_program(60.0)
        assert (chamber.read().mode, chamber.read().conditioning) == ("RUN", True)
        chamber.hold(40.0)
        assert (chamber.read().mode, set_point(device, clock)) == ("CONSTANT", 40.0)
        with pytest.raises(Rejected, match="steps of the set point"):
            chamber.ramp(50.0, 1.0)
        device.raise_alarm(18)
        assert (chamber.read().alarms, chamber.read().conditioning) == (("18",), False)


def test_what_an_espec_refuses_or_only_acknowledges_is_said():
    with espec_bench() as (chamber, device, port, _):
        device._enter = lambda mode: None  # local mode at the panel: it says OK and stays as it is
        with pytest.raises(NotVerified, match="read-back"):
            chamber.hold(30.0)
        device._command = lambda text: "PROTECT ON"
        with pytest.raises(Rejected, match=f"ESPEC at {port.url} was sent 'TEMP, S40.0.*PROTECT ON"):
            chamber.hold(40.0)


def test_a_lost_acknowledgement_repeats_no_command():
    faults = Faults()
    with espec_bench(faults=faults) as (chamber, device, *_):
        chamber.hold(20.0)
        device.commands.clear()
        # Questions before the command: limits, mode; the third message is the acknowledgement.
        faults.once("split", "split", "drop")
        chamber.hold(31.0)
        assert [text for text in device.commands if text.startswith("TEMP, S")] == ["TEMP, S31.0"]


# ---------------------------------------------------------------------------------------------------------- registers


def test_f4t_whose_loop_stays_off_is_noticed_and_one_that_was_off_is_switched_on_first():
    with f4t_bench() as (chamber, device, _, clock):
        # Somebody wrote a set point beforehand, to a loop that is off.
        device.put(2782, -30.0)
        assert (chamber.read().conditioning, chamber.read().setpoint_c) == (False, 23.0)
        chamber.hold(-30.0)
        assert set_point(device, clock) == -30.0
        device.words[16568] = 149
        assert chamber.read().mode == "PROFILE"
        chamber.hold(-20.0)
        assert chamber.read().mode == "AUTO"
        device.words |= {1556: 12, 1456: 10}
        assert chamber.read().alarms == ("alarm 2",)
        chamber.standby()
        device.locked = True
        with pytest.raises(NotVerified, match="Watlow F4T: on"):
            chamber.hold(20.0)
        device.words[6730] = 30
        with pytest.raises(Rejected, match="not Celsius"):
            chamber.identify()


# --------------------------------------------------------------------------------------------------------------- axes


@of_axes
def test_every_axis_homes_turns_spins_and_stops(bench):
    with bench() as (axis, device, _, clock):
        with pytest.raises(DeviceFault):
            axis.move_to(10.0, 50.0, 100.0)
        axis.home()
        assert axis.read().referenced
        for wrong in ((10.0, 1e5, 100.0), (10.0, 50.0, 1e6)):
            with pytest.raises(LimitExceeded, match="the axis accepts up to"):
                axis.move_to(*wrong)
        use_axis(axis, device, clock, 0)
        way_deg = 720.0 - axis.read().position_deg
        axis.move_to(720.0, 150.0, 300.0)
        assert come_to_rest(axis, clock) == pytest.approx(way_deg / 150.0 + 0.5, abs=0.3)
        assert axis.read().position_deg == pytest.approx(720.0, abs=0.01)
        # After a move to an angle: the controller's mode must have been changed back for a spin to work.
        axis.spin(-200.0, 250.0)
        clock.sleep(3.0)
        axis.read()
        clock.sleep(5.0)
        reading = axis.read()
        assert reading.moving
        assert reading.rate_dps == pytest.approx(-200.0, rel=1e-3)
        # One that moves takes another command.
        axis.spin(30.0, 200.0)
        clock.sleep(3.0)
        assert rate_dps(device, clock) == pytest.approx(30.0, rel=1e-3)
        axis.move_to(45.0, 60.0, 200.0)
        come_to_rest(axis, clock)
        assert axis.read().position_deg == pytest.approx(45.0, abs=0.01)
        assert axis.safe("hold").verified


def test_direction_and_zero_of_the_rig_file():
    config = lines_config("aerosmith-like", direction=-1, zero="90 deg")
    with aerosmith_bench(config) as (axis, device, _, clock):
        axis.home()
        assert axis.read().position_deg == 90.0
        axis.move_to(120.0, 50.0, 100.0)
        come_to_rest(axis, clock)
        assert axis.read().position_deg == pytest.approx(120.0, abs=0.01)
        assert device.plant.state(clock.now())[0] == pytest.approx(-30.0, abs=0.01)
        axis.spin(20.0, 100.0)
        clock.sleep(2.0)
        assert rate_dps(device, clock) == -20.0


@of_axes
def test_a_reply_that_the_host_reads_late_makes_no_rate_too_large(bench, monkeypatch):
    """Of a device whose position comes with its state, and of one that is asked for it."""
    late = [0.3]
    with bench() as (axis, _, _, clock):
        axis.home()
        axis.spin(100.0, 200.0)
        clock.sleep(2.0)
        ask = axis._ask

        def read_late(question):
            reply = ask(question)
            clock.sleep(late[0])
            return reply

        monkeypatch.setattr(axis, "_ask", read_late)
        axis.read()
        late[0] = 0.0
        clock.sleep(0.5)
        assert 50.0 < axis.read().rate_dps < 101.0


def test_grbl_that_restarted_has_no_reference_and_does_not_move():
    with grbl_bench() as (axis, device, port, clock):
        axis.home()
        axis.move_to(10.0, 50.0, 100.0)
        clock.sleep(5.0)
        device.reboot()
        assert axis.read().faults == ("Alarm",)
        # Unlocked at the board it counts from nought again: it is not referenced for that.
        device.receive(b"$X\n")
        with pytest.raises(DeviceFault, match="no reference"):
            axis.move_to(20.0, 50.0, 100.0)
        device.settings[22] = 0.0
        with pytest.raises(Rejected, match="lost its reference"):
            axis.identify()
        device.settings[22] = 1.0
        device.finds_switch = False
        with pytest.raises(HardwareError):
            axis.home()
        device.finds_switch = True
        axis.home()
        for message in device.hard_limit():
            port.say(message)
        with pytest.raises(ReplyTimeout):
            axis.read()


def test_grbl_stops_where_it_stands_and_its_settings_are_put_back():
    """A feed hold where nothing moves would lock the board; a cancelled jog does not."""
    with grbl_bench() as (axis, device, port, clock):
        axis.home()
        assert axis.safe("hold").verified
        assert axis.read().faults == ()
        before = dict(device.settings)
        axis.spin(60.0, 120.0)
        assert device.settings[120] == 120.0
        clock.sleep(2.0)
        axis.stop()
        axis.settings.put_back()
        assert device.settings == before
        device._jog_line = lambda _: b"error:15\r\n"
        with pytest.raises(Rejected, match=f"GRBL at {port.url} was sent .*error:15"):
            axis.spin(10.0, 100.0)


def test_a_board_that_restarts_when_its_port_is_opened_is_given_its_time():
    with grbl_bench() as (axis, device, _, clock):
        receive, heard = device.receive, []

        def deaf_at_first(data):
            heard.append(clock.now())
            return receive(data) if clock.now() >= 2.0 else []

        device.receive = deaf_at_first
        axis.identify()
    assert heard[0] >= 2.5


def test_a_rate_that_was_lost_lets_no_table_go_and_its_power_is_its_operators():
    with aerosmith_bench() as (axis, device, _, clock):
        axis.home()
        receive = device.receive
        device.receive = lambda data: [b"\r\n>"] if data.startswith((b"VEL0", b"VEL5")) else receive(data)
        with pytest.raises(NotVerified, match="rate 50"):
            axis.move_to(90.0, 50.0, 100.0)
        assert not device.plant.moving(clock.now())
        device.receive = receive
        axis.move_to(90.0, 50.0, 100.0)
        assert axis.safe("unpower").verified
        assert not device.servo
        with pytest.raises(DeviceFault, match="this run did not switch it off"):
            axis.move_to(0.0, 50.0, 100.0)


# ------------------------------------------------------------------------------------------------------- spoilt lines


def made_safe(driver, how):
    try:
        return driver.safe(how).verified
    except HardwareError:
        return False


@pytest.mark.parametrize("way", ["commands", "faults"])
@pytest.mark.parametrize("fault", ["drop", "duplicate", "flip", "delay", "always"])
@pytest.mark.parametrize("bench", [*CHAMBERS.values(), *AXES.values()], ids=[*CHAMBERS, *AXES])
def test_lines_lost_doubled_damaged_and_late_once_and_always(bench, fault, way):
    """Commands, or replies, of a session: each in its turn suffers the fault, or all of them one of several."""
    often = dict.fromkeys(("drop", "truncate", "duplicate", "noise"), 0.04) if fault == "always" else {}
    faults = Faults(seed=5, delay_s=0.15, probability=often)
    use, safe = (use_axis, "hold") if bench in AXES.values() else (use_chamber, "standby")
    refused = 0
    with bench(**{way: faults}) as (driver, device, _, clock):
        for number in range(12):
            # The other lines of the session pass: a line that is split is whole again.
            faults._next.clear()
            if not often:
                faults.once(*["split"] * (number if use is use_chamber else 5 * number), fault)
            try:
                use(driver, device, clock, number)
            except HardwareError:
                refused += 1  # said to whoever asked, and the run ends
                clock.sleep(20.0)
        faults.probability.clear()
        faults._next.clear()
        assert any(made_safe(driver, safe) for _ in range(5))
    # What a device itself refuses of a damaged line is said, too.
    assert refused <= (12 if fault in ("flip", "always") and way == "commands" else 4 if not often else 9), refused


# ------------------------------------------------------------------------------------------------------- late answers


def late(delay_s, begins=b""):
    """Messages that begin so come so many seconds after they were sent."""
    return lambda message: [(delay_s if message.startswith(begins) else 0.0, message)]


def test_a_reply_within_twice_the_time_out_counts_and_is_said_to_be_late():
    with espec_bench(espec_config("0 s")) as (chamber, _, port, _):
        port.faults = late(0.45)
        assert chamber._fields("air")["air"] == "23.0"
        assert f"ESPEC at {port.url} was sent 'TEMP?" in port.late
        assert "s late: raise reply_timeout" in port.late
        # To "TYPE?" it comes in time for no other question, though the answer to "ROM?" may be any text.
        assert chamber.identify().firmware == "P3S1.10"


def test_a_later_reply_counts_for_no_other_question():
    """The query fails, and what still comes is awaited before the next."""
    with espec_bench(espec_config("0 s")) as (chamber, _, port, _):
        port.faults = late(1.4)
        with pytest.raises(ReplyTimeout, match=r"did not answer in 0\.3 s.*ESPEC answered up to .*: raise"):
            chamber._fields("air")
        port.faults = None
        assert chamber.identify().firmware == "P3S1.10"
