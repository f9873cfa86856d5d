"""A simulated ODrive with two motors: the peer of `drivers.odrive`, written from the protocol and firmware habits.

Strict: a line with a wrong check sum vanishes without an answer; a reply has a check sum if the request had one and is
cut at 64 bytes, a property of firmware 0.5 at ten characters; `t` leaves trapezoid mode behind, in which `v` is
ignored; positions read 0.0 while the encoder is not ready; the watchdog, once on, sets the motor idle when it is not
fed, and an idle motor coasts.
"""

import re
from dataclasses import dataclass, field

from ..checksums import xor8
from ..clock import Clock
from .plants import AxisPlant

_LONGEST_LINE = 256


@dataclass
class ODriveOptions:
    generation: str = "0.5"
    turns_per_table_turn: float = 1.0
    max_turns_per_s: float = 5.0


@dataclass
class _Axis:
    plant: AxisPlant
    state: int = 1
    error: int = 0
    ready: bool = True
    fed_s: float = 0.0
    values: dict[str, float] = field(default_factory=dict[str, float])


class SimulatedODrive:
    def __init__(self, plants: list[AxisPlant], clock: Clock, options: ODriveOptions | None = None) -> None:
        self.options = options or ODriveOptions()
        self._clock = clock
        self._buffer = b""
        self.vanished_lines = 0
        self.ignored_velocities = 0
        self.axes = [_Axis(plant) for plant in plants]
        for axis in self.axes:
            axis.values = {
                "controller.config.vel_limit": self.options.max_turns_per_s,
                "controller.config.vel_ramp_rate": 1.0,
                "controller.config.control_mode": 3.0,
                "controller.config.input_mode": 1.0,
                "controller.input_vel": 0.0,
                "controller.input_pos": 0.0,
                "trap_traj.config.vel_limit": 2.0,
                "trap_traj.config.accel_limit": 0.5,
                "trap_traj.config.decel_limit": 0.5,
                "config.watchdog_timeout": 0.0,
                "config.enable_watchdog": 0.0,
                "requested_state": 0.0,
            }

    def receive(self, data: bytes) -> list[bytes]:
        self._buffer += data
        *lines, self._buffer = re.split(rb"[\r\n!]", self._buffer)
        if len(self._buffer) > _LONGEST_LINE:
            self._buffer = self._buffer[:_LONGEST_LINE] + b"\xff"
        return [reply for line in lines for reply in self._line(line)]

    def next_emission_s(self) -> float | None:
        """The watchdogs' next expiry: the board acts by itself then, though it says nothing."""
        expiries = [e for axis in self.axes if (e := self._expiry(axis)) is not None]
        return min(expiries, default=None)

    def emit(self, now_s: float) -> list[bytes]:
        for axis in self.axes:
            expiry = self._expiry(axis)
            if expiry is not None and expiry <= now_s:
                self._trip(axis, 0x800 if self.options.generation == "0.5" else 0x01000000)
        return []

    def fault(self, bits: int, motor: int = 0) -> None:
        self._trip(self.axes[motor], bits)

    def lose_encoder(self, motor: int = 0) -> None:
        self.axes[motor].ready = False
        self._trip(self.axes[motor], 0x100)

    def reboot(self) -> None:
        self._buffer = b""
        for axis in self.axes:
            axis.state, axis.error = 1, 0
            axis.values["config.enable_watchdog"] = 0.0
            axis.plant.coast(self._clock.now())

    # -------------------------------------------------------------------------------------------------------- parts

    def _expiry(self, axis: _Axis) -> float | None:
        if axis.values["config.enable_watchdog"] and axis.state == 8:
            return axis.fed_s + axis.values["config.watchdog_timeout"]
        return None

    def _trip(self, axis: _Axis, bits: int) -> None:
        axis.error |= bits
        if axis.state != 1:
            axis.state = 1
            axis.plant.coast(self._clock.now())

    def _line(self, line: bytes) -> list[bytes]:
        line = line.split(b";")[0]
        if len(line) > _LONGEST_LINE:
            return []
        body, star, check = line.rpartition(b"*")
        if star:
            if check.strip() != str(xor8(body)).encode():
                self.vanished_lines += 1
                return []
            line = body
        words = line.decode("latin-1").split()
        replies: list[bytes] = []
        for text in self._answer(words) if words else []:
            sent = text.encode("ascii")[:64]
            replies.append(sent + (b"*%d" % xor8(sent) if star else b"") + b"\r\n")
        return replies

    def _answer(self, words: list[str]) -> list[str]:
        command, *arguments = words
        if command == "i":
            version = "0.5.6" if self.options.generation == "0.5" else "0.6.11"
            return ["Hardware version: 3.6-56V", f"Firmware version: {version}", "Serial number: 2088399A4D4D"]
        if command in ("r", "w"):
            return self._access(command, arguments)
        if command in ("f", "v", "t", "u", "p"):
            if not arguments or not arguments[0].isdigit():
                return ["invalid command format"]
            if int(arguments[0]) >= len(self.axes):
                return [f"invalid motor {arguments[0]}"]
            axis = self.axes[int(arguments[0])]
            try:
                numbers = [float(text) for text in arguments[1:]]
            except ValueError:
                return ["invalid command format"]
            return self._motor(axis, command, numbers)
        if command in ("sc",):
            for axis in self.axes:
                axis.error = 0
            return []
        return ["unknown command"]

    def _motor(self, axis: _Axis, command: str, numbers: list[float]) -> list[str]:
        now = self._clock.now()
        if command == "f":
            if not axis.ready:
                return ["0.000000 0.000000"]
            _, rate = axis.plant.state(now)
            return [f"{self._turns(axis.plant.reading(now)):.6f} {self._turns(rate):.6f}"]
        axis.fed_s = now
        if command == "u":
            return []
        if not numbers:
            return ["invalid command format"]
        if command == "v":
            axis.values["controller.config.control_mode"] = 2.0
            axis.values["controller.input_vel"] = numbers[0]
            if axis.values["controller.config.input_mode"] == 5.0:
                self.ignored_velocities += 1
            elif axis.state == 8:
                limit = axis.values["controller.config.vel_limit"]
                rate = self._degrees(min(max(numbers[0], -limit), limit))
                axis.plant.spin(now, rate, self._degrees(axis.values["controller.config.vel_ramp_rate"]))
        elif command == "t":
            axis.values["controller.config.control_mode"] = 3.0
            axis.values["controller.config.input_mode"] = 5.0
            axis.values["controller.input_pos"] = numbers[0]
            if axis.state == 8:
                rate, acceleration = (
                    self._degrees(axis.values[f"trap_traj.config.{name}_limit"]) for name in ("vel", "accel")
                )
                axis.plant.move_to(now, self._degrees(numbers[0]), rate, acceleration)
        return []

    def _access(self, command: str, arguments: list[str]) -> list[str]:
        if not arguments:
            return ["invalid command format"]
        if arguments[0] == "vbus_voltage" and command == "r":
            return ["24.087744"]
        match = re.fullmatch(r"axis(\d)\.(.+)", arguments[0])
        if match is None or int(match[1]) >= len(self.axes):
            return ["invalid property"]
        axis, path = self.axes[int(match[1])], match[2]
        if command == "r":
            text = self._property(axis, path)
            if text is None:
                return ["invalid property"]
            return [text[:10] if self.options.generation == "0.5" else text]
        if path not in axis.values or len(arguments) != 2:
            return ["invalid property"]
        try:
            value = float(arguments[1])
        except ValueError:
            return ["invalid command format"]
        axis.values[path] = value
        if path == "requested_state":
            self._request_state(axis, int(value))
        return []

    def _property(self, axis: _Axis, path: str) -> str | None:
        old = self.options.generation == "0.5"
        if path == "current_state":
            return str(axis.state)
        if path == ("error" if old else "active_errors"):
            return str(axis.error)
        if path == "encoder.is_ready" and old:
            return str(int(axis.ready))
        if path not in axis.values:
            return None
        value = axis.values[path]
        whole = path.endswith(("mode", "enable_watchdog", "state"))
        return str(int(value)) if whole else f"{value:.6f}"

    def _request_state(self, axis: _Axis, state: int) -> None:
        now = self._clock.now()
        if state == 8:
            if axis.error or not axis.ready:
                return
            axis.state, axis.fed_s = 8, now
            axis.plant.spin(now, 0.0, 1e4)
        elif state == 1:
            axis.state = 1
            axis.plant.coast(now)
        elif state == 11:
            axis.plant.set_zero(now)
            axis.state = 1
        else:
            axis.error |= 0x1

    def _turns(self, degrees: float) -> float:
        return degrees / 360.0 * self.options.turns_per_table_turn

    def _degrees(self, turns: float) -> float:
        return turns * 360.0 / self.options.turns_per_table_turn
