"""Zaber rotary stages: the ASCII protocol, with message ids and checksums on every command.

Source: the vendor's packages `zaber.serial` and `zaber-motion`. 115200 8N1. A device answers `@ device axis id OK|RJ
BUSY|IDLE warning data`; infos (`#`) and alerts (`!`) may come at any time and are passed over. The check is the two's
complement of the sum of all characters after the first, as two hexadecimal digits.

Positions are microsteps; microsteps a turn come from `limit.cycle.dist`, or from `microsteps_per_turn` in the rig file
for devices without that setting.

Unverified on real hardware: `velocity_factor` and `acceleration_factor` (data value per microstep/s and microstep/s²;
time a known move at commissioning); the exact effect of `set comm.checksum 1`: the driver sends it, and requires a
checksum in every reply if it was accepted and the next reply has one (see `reply_checksum`).
Rates are not read from the device (see `base.AxisDriver`).

Firmware 6 calls its identity `deviceid`, firmware 7 `device.id`. Settings outlive a session: they are set only where
they differ (whether a stage writes them to its flash memory at each `set` is open), and put back at the end.
"""

import re
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from gradcal_jax.hardware.checksums import lrc_zaber
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import AxisDriver, AxisOptions, codes_of
from gradcal_jax.hardware.errors import ChecksumError, DeviceFault, FramingError, Rejected, printable
from gradcal_jax.hardware.framing import LineFramer, NotThisReply
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, AxisSafe, Identity, KeptSettings, SafeReport
from gradcal_jax.hardware.transport import Transport

_WARNINGS = codes_of("zaber")
_UNREFERENCED = {"WR", "WH"}
_REPLY = re.compile(r"@(\d{1,2}) (\d) (?:(\d{1,2}) )?(OK|RJ) (BUSY|IDLE) (--|[A-Z]{2}) (\S.*)")


@dataclass(frozen=True)
class ZaberConfig(AxisOptions):
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    baudrate: int = 115200
    reply_timeout_s: float = 0.5
    microsteps_per_turn: int = 0
    velocity_factor: float = 1.6384
    acceleration_factor: float = 1.6384e-4
    max_rate_dps: float = 360.0
    max_acceleration_dps2: float = 300.0
    unpower_command: str = ""

    def lacks_for(self, safe: str) -> str:
        if safe != AxisSafe.UNPOWER.value or self.unpower_command:
            return ""
        return 'the command for switching off the motor depends on the stage: state unpower_command, or choose "hold"'


@dataclass(frozen=True)
class Reply:
    """One `@` message. `message_id` is None where the device sent none."""

    device: int
    axis: int
    message_id: int | None
    accepted: bool
    busy: bool
    warning: str
    data: str
    checked: bool


def command(device: int, axis: int, message_id: int, words: str) -> bytes:
    body = f"{device} {axis} {message_id}{' ' if words else ''}{words}"
    return f"/{body}:{lrc_zaber(body.encode()):02X}\n".encode("ascii")


def parse_reply(frame: bytes, *, demand_checksum: bool) -> Reply:
    """Raises `NotThisReply` for infos and alerts, `ChecksumError`, `FramingError`. Check digits are upper case."""
    if frame[:1] in (b"#", b"!"):
        raise NotThisReply
    body, colon, check = frame[1:].rpartition(b":")
    checked = bool(colon) and len(check) == 2
    if checked and check != b"%02X" % lrc_zaber(body):
        raise ChecksumError(f"The reply {printable(frame)!r} has a wrong checksum. Check the line's shielding.")
    if demand_checksum and not checked:
        raise ChecksumError(f"The reply {printable(frame)!r} has no checksum, although this device sends checksums.")
    text = frame[:1] + (body if checked else frame[1:])
    match = _REPLY.fullmatch(text.decode("ascii", "replace"))
    if match is None:
        raise FramingError(f"{printable(frame)!r} is not a Zaber reply. Check port and baud rate.")
    number = int(match[3]) if match[3] is not None else None
    return Reply(
        int(match[1]), int(match[2]), number, match[4] == "OK", match[5] == "BUSY", match[6], match[7], checked
    )


def open_exchange(transport: Transport, clock: Clock, config: ZaberConfig) -> Exchange:
    return Exchange(transport, LineFramer(), clock, "The Zaber stage", config.reply_timeout_s)


class ZaberAxis(AxisDriver[ZaberConfig]):
    """Role `MotionAxis`. Several axes of one chain share an exchange."""

    def __init__(self, exchange: Exchange, config: ZaberConfig) -> None:
        super().__init__(exchange, config)
        self._message_id = 0
        self._steps_per_turn = float(config.microsteps_per_turn)
        self.reply_checksum = False
        self.settings = KeptSettings(self._setting, self._set)

    def identify(self) -> Identity:
        # Not every stage has each of them; they are restored at the end.
        for name, value in (("comm.checksum", "1"), ("comm.alert", "0"), ("knob.enable", "0")):
            with suppress(Rejected):
                self.settings.change(name, value)
        try:
            model = self._setting("device.id")
        except Rejected:
            model = self._setting("deviceid")  # the name of firmware 6
        self.reply_checksum = self._ask("get system.serial", axis=0).checked
        serial, firmware = self._setting("system.serial"), self._setting("version")
        details = {"microsteps a turn": f"{self._per_turn():g}"}
        details["replies"] = "with checksum" if self.reply_checksum else "without checksum"
        return Identity("zaber", f"device {model}", serial, firmware, details)

    def limits(self) -> AxisLimits:
        turn, config = self._per_turn(), self._config
        low, high = (float(self._setting(name)) for name in ("limit.min", "limit.max"))
        # Limits as wide as the integers that hold them are no limits.
        lowest, highest = (None, None) if high - low >= 2.0**31 else sorted((self._degrees(low), self._degrees(high)))
        # The data value of a rate is a 32-bit integer.
        most = min(config.max_rate_dps, 2.0**31 / self._velocity_data()), config.max_acceleration_dps2
        step = 360.0 / (turn * config.acceleration_factor)
        return AxisLimits(*most, lowest, highest, 360.0 / turn, hardware_watchdog=False, acceleration_step_dps2=step)

    def read(self) -> AxisReading:
        asked_s = self._clock.now()
        reply = self._ask("get pos")
        time_s = self._clock.now()
        position = self._degrees(_number(reply))
        rate = self._mean_rate(asked_s, time_s, position, moving=reply.busy)
        flag = reply.warning
        faults, warnings = ((_meaning(flag),) if flag.startswith(kind) else () for kind in "FW")
        return AxisReading(time_s, position, rate, reply.busy, flag not in _UNREFERENCED, faults, warnings)

    def home(self) -> None:
        self._ask("home")
        reading = self._until_still(self._config.home_timeout_s, "homing")
        if not reading.referenced:
            raise DeviceFault("The axis stopped without finding its reference. Look at the stage.")

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        self._require_travel(position_deg, self.limits().travel_deg)
        self._require_ready(referenced=True)
        self._prepare(rate_dps, acceleration_dps2)
        self.settings.change("maxspeed", str(round(rate_dps * self._velocity_data())))
        self._start(f"move abs {round(self._own(position_deg))}")

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        self._prepare(abs(rate_dps), acceleration_dps2)
        self._start(f"move vel {round(rate_dps * self._config.direction * self._velocity_data())}")

    def stop(self) -> None:
        self._ask("stop")
        self._until_still(self._config.stop_timeout_s, "stopping")

    def safe(self, policy: AxisSafe) -> SafeReport:
        self._ask("stop")
        self._until_still(self._config.stop_timeout_s, "stopping", raise_faults=False)
        lack = self._config.lacks_for(policy.value)
        return self._left_safe(policy, lack, lambda: self._ask(self._config.unpower_command))

    def _ask(self, words: str, *, axis: int | None = None) -> Reply:
        """Send a command. All commands of this driver are absolute, hence harmless when repeated."""
        config, number = self._config, self._config.axis if axis is None else axis
        with self._exchange.alone():
            self._message_id = message_id = (self._message_id + 1) % 100

            def parse(frame: bytes) -> Reply:
                reply = parse_reply(frame, demand_checksum=self.reply_checksum)
                if (reply.device, reply.axis, reply.message_id) != (config.device, number, message_id):
                    raise NotThisReply
                return reply

            reply = self._exchange.query(command(config.device, number, message_id, words), parse)
        if not reply.accepted:
            text = f"{reply.data}, {reply.warning}" if reply.warning != "--" else reply.data
            raise Rejected(f"{self._title} at {self._exchange.transport.url} refuses {words!r}: {text}.")
        return reply

    def _start(self, words: str) -> None:
        reply = self._ask(words)
        if reply.warning.startswith("F"):
            raise DeviceFault(f"The stage reports {_meaning(reply.warning)}.")

    def _setting(self, name: str) -> str:
        return self._ask(f"get {name}", axis=_axis_of(name)).data

    def _set(self, name: str, value: str) -> None:
        if (name, value) == ("comm.checksum", "0"):
            self.reply_checksum = False
        self._verify(
            f"The setting {name} = {value}",
            lambda: self._ask(f"set {name} {value}", axis=_axis_of(name)),
            lambda: self._setting(name),
            lambda shown: shown == value,
        )

    def _prepare(self, rate_dps: float, acceleration_dps2: float) -> None:
        config = self._config
        self._require_motion(rate_dps, config.max_rate_dps, acceleration_dps2, config.max_acceleration_dps2)
        self.settings.change("accel", str(max(1, round(self._units(acceleration_dps2) * config.acceleration_factor))))

    def _per_turn(self) -> float:
        if not self._steps_per_turn:
            try:
                self._steps_per_turn = _number(self._ask("get limit.cycle.dist"))
            except Rejected:
                raise Rejected(
                    "The stage does not report its microsteps per revolution (limit.cycle.dist). Write "
                    "the number from its data sheet as microsteps_per_turn in the rig file."
                ) from None
        return self._steps_per_turn

    def _velocity_data(self) -> float:
        return self._units(1.0) * self._config.velocity_factor


def _axis_of(setting: str) -> int | None:
    """A setting: of the whole device with axis 0, of the rig file's axis with None."""
    return 0 if setting.startswith(("comm.", "knob.", "device", "system.", "version")) else None


def _meaning(flag: str) -> str:
    return f"{flag} ({_WARNINGS.get(flag, 'see the manual')})"


def _number(reply: Reply) -> float:
    if re.fullmatch(r"-?\d+(\.\d+)?", reply.data) is None:
        raise FramingError(f"The stage answered {reply.data!r} instead of a number.")
    return float(reply.data)
