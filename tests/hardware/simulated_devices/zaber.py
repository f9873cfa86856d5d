"""Simulated Zaber rotary stages on one chain: the peer of `drivers.zaber`, written from the protocol.

Strict: a command with a wrong checksum is ignored, a message id is returned when one was sent, checksums are added to
replies after `set comm.checksum 1`, absolute moves are refused with `WR` before homing, everything that moves is
refused while `FF` or `FH` is up, and infos or alerts may come between (`chatter`).
"""

import re
from dataclasses import dataclass, field

from simulated_devices.limited_axis import LimitedAxis

from gradcal_jax.hardware.checksums import lrc_zaber
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import AxisPlant

_COMMAND = re.compile(r"/(?:(\d+) ?)?(?:(\d+) ?)?(?:(\d+) ?)?(.*)")


@dataclass
class ZaberOptions:
    device_id: int = 50081
    firmware: int = 7
    serial: int = 12345
    microsteps_per_turn: int = 1152000
    tells_cycle: bool = True
    velocity_factor: float = 1.6384
    acceleration_factor: float = 1.6384e-4
    endless: bool = True
    chatter: bool = False
    home_rate_dps: float = 30.0


@dataclass
class _Stage:
    plant: AxisPlant
    warning: str = "WR"
    homing_until_s: float = -1.0
    settings: dict[str, int] = field(default_factory=dict[str, int])


class SimulatedZaber:
    """Devices 1, 2, … with one axis and one plant each."""

    def __init__(self, plants: list[AxisPlant], clock: Clock, options: ZaberOptions | None = None) -> None:
        self.options = options or ZaberOptions()
        self._clock = clock
        self._buffer = b""
        self._checksums = False
        turn = self.options.microsteps_per_turn
        self.stages = [_Stage(plant) for plant in plants]
        for number, stage in enumerate(self.stages):
            stage.settings = {
                ("device.id" if self.options.firmware >= 7 else "deviceid"): self.options.device_id,
                "system.serial": self.options.serial + number,
                "resolution": 64,
                "maxspeed": round(turn / 360 * 100 * self.options.velocity_factor),
                "accel": round(turn / 360 * 200 * self.options.acceleration_factor),
                "limit.min": -(2**31) if self.options.endless else 0,
                "limit.max": 2**31 - 1 if self.options.endless else turn,
                "knob.enable": 1,
                "comm.alert": 1,
                "comm.checksum": 0,
            }
            if self.options.tells_cycle:
                stage.settings["limit.cycle.dist"] = turn

    def receive(self, data: bytes) -> list[bytes]:
        self._buffer += data
        replies: list[bytes] = []
        while (end := self._buffer.find(b"\n")) >= 0:
            line, self._buffer = self._buffer[:end].rstrip(b"\r"), self._buffer[end + 1 :]
            if (start := line.rfind(b"/")) >= 0:
                replies += self._line(line[start:])
        return replies

    def fault(self, flag: str, device: int = 1) -> None:
        """Raise a warning flag; `FS` (stalled) and `FH` (emergency stop) also stop the axis where it is."""
        stage = self.stages[device - 1]
        stage.warning = flag
        if flag in ("FS", "FH"):
            now = self._clock.now()
            stage.plant.set_zero(now, stage.plant.state(now)[0])

    def reboot(self) -> None:
        """Power cut: standstill, reference lost, communication settings as at power-on."""
        self._buffer, self._checksums = b"", False
        now = self._clock.now()
        for stage in self.stages:
            stage.warning = "WR"
            stage.plant.set_zero(now, stage.plant.state(now)[0])
            stage.settings |= {"comm.alert": 1, "comm.checksum": 0}

    def _line(self, line: bytes) -> list[bytes]:
        if len(line) > 3 and line[-3:-2] == b":":
            if line[-2:] != b"%02X" % lrc_zaber(line[1:-3]):
                return []
            line = line[:-3]
        match = _COMMAND.fullmatch(line.decode("latin-1"))
        assert match is not None
        device, axis = int(match[1] or 0), int(match[2] or 0)
        number = "" if match[3] is None else f" {int(match[3]):02d}"
        words = match[4].strip()
        replies: list[bytes] = []
        for address, stage in enumerate(self.stages, start=1):
            if device not in (0, address):
                continue
            # One time for the whole reply: a position read while the axis turned never comes with "IDLE".
            now = self._clock.now()
            accepted, data = (False, "BADAXIS") if axis > 1 else self._obey(stage, words, now)
            state = "BUSY" if self._busy(stage, now) else "IDLE"
            flag = stage.warning or "--"
            if self.options.chatter and stage.settings["comm.alert"]:
                replies.append(self._message(f"!{address:02d} 1 {state} {flag}"))
                replies.append(b"#%02d 0 a word from the device\r\n" % address)
            replies.append(
                self._message(f"@{address:02d} {axis}{number} {'OK' if accepted else 'RJ'} {state} {flag} {data}")
            )
        return replies

    def _message(self, text: str) -> bytes:
        body = text.encode("ascii")
        return body + (b":%02X" % lrc_zaber(body[1:]) if self._checksums else b"") + b"\r\n"

    def _busy(self, stage: _Stage, now: float) -> bool:
        if 0.0 <= stage.homing_until_s <= now:
            stage.homing_until_s = -1.0
            stage.plant.set_zero(now)
            stage.warning = "" if stage.warning in ("WR", "WH") else stage.warning
        position, rate = stage.plant.state(now)
        stands = rate == 0.0 and stage.homing_until_s < 0.0 and position != 0.0
        if isinstance(stage.plant, LimitedAxis) and stands and position in stage.plant.ends_deg:
            stage.warning = "FE"
        return stage.homing_until_s >= 0.0 or stage.plant.moving(now)

    def _obey(self, stage: _Stage, words: str, now: float) -> tuple[bool, str]:
        busy = self._busy(stage, now)
        head, _, rest = words.partition(" ")
        if not words:
            return True, "0"
        if head == "get":
            return self._get(stage, rest, now)
        if head == "set":
            return self._set(stage, rest)
        if head in ("stop", "estop"):
            stage.homing_until_s = -1.0
            stage.plant.spin(now, 0.0, self._acceleration(stage))
            return True, "0"
        if head in ("home", "move") and stage.warning in ("FF", "FH"):
            return False, "DRIVERDISABLED"
        if head == "home":
            position, _ = stage.plant.state(now)
            away = (position + 180.0) % 360.0 - 180.0
            stage.plant.move_to(now, position - away, self.options.home_rate_dps, self._acceleration(stage))
            stage.homing_until_s = now + abs(away) / self.options.home_rate_dps + 1.0
            return True, "0"
        if head == "move":
            return self._move(stage, rest, now, busy)
        if words == "warnings clear":
            stage.warning = ""
            return True, "0"
        return False, "BADCOMMAND"

    def _get(self, stage: _Stage, name: str, now: float) -> tuple[bool, str]:
        if name in ("pos", "encoder.pos"):
            return True, str(round(stage.plant.reading(now) / 360.0 * self.options.microsteps_per_turn))
        if name == "version":
            return True, "7.28" if self.options.firmware >= 7 else "6.18"
        return (True, str(stage.settings[name])) if name in stage.settings else (False, "BADCOMMAND")

    def _set(self, stage: _Stage, rest: str) -> tuple[bool, str]:
        name, _, text = rest.partition(" ")
        if name not in stage.settings:
            return False, "BADCOMMAND"
        if re.fullmatch(r"-?\d+", text) is None or (name in ("maxspeed", "accel") and int(text) <= 0):
            return False, "BADDATA"
        stage.settings[name] = int(text)
        if name == "comm.checksum":
            self._checksums = int(text) == 1
        return True, "0"

    def _move(self, stage: _Stage, rest: str, now: float, busy: bool) -> tuple[bool, str]:
        kind, _, text = rest.partition(" ")
        if re.fullmatch(r"-?\d+", text) is None:
            return False, "BADDATA"
        turn, value = self.options.microsteps_per_turn, int(text)
        if stage.homing_until_s >= 0.0 and busy:
            return False, "STATUSBUSY"
        if kind == "vel":
            rate = value / self.options.velocity_factor / turn * 360.0
            stage.plant.spin(now, rate, self._acceleration(stage))
            return True, "0"
        if kind not in ("abs", "rel"):
            return False, "BADCOMMAND"
        if kind == "abs" and stage.warning in ("WR", "WH"):
            return False, "BADDATA"
        target = value + (round(stage.plant.state(now)[0] / 360.0 * turn) if kind == "rel" else 0)
        if not stage.settings["limit.min"] <= target <= stage.settings["limit.max"]:
            return False, "BADDATA"
        rate = stage.settings["maxspeed"] / self.options.velocity_factor / turn * 360.0
        stage.plant.move_to(now, target / turn * 360.0, rate, self._acceleration(stage))
        return True, "0"

    def _acceleration(self, stage: _Stage) -> float:
        turn = self.options.microsteps_per_turn
        return stage.settings["accel"] / self.options.acceleration_factor / turn * 360.0
