"""A simulated ODrive with two motors: the peer of `drivers.odrive`, written from the firmware's source (0.5.6).

Strict in what it says: a line with a wrong checksum vanishes without an answer; a reply has a checksum if the request
had one and is cut at 64 bytes, a property of firmware 0.5 at ten characters; positions are float32, and read 0.0 while
the encoder is not ready.

Strict in what it remembers (`Controller::update`, `Axis::watchdog_check`): `t` assigns control and input mode without
synchronising, and plans from `pos_setpoint`, which no command of velocity moves; where that is not where the motor
stands, the position loop first drives it there as fast as `vel_limit` lets it. Writing `control_mode` through its
property sets `pos_setpoint` to the estimate; closing the loop sets it to nought, unless the mode is of position. `v` is
ignored in trapezoid mode, and an `input_vel` of before acts as soon as the input mode lets it. A velocity loop at
nought gives way to an unbalanced load (`unbalanced_dps`). The watchdog, once on, expires in every state; an error stays
until `sc`, and with one the loop is not closed. An idle motor coasts.
"""

import re
from dataclasses import dataclass, field

import numpy as np

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import AxisPlant

_FRICTION_DPS2 = 20.0  # alone slows what has no power
_LONGEST_LINE = 256
_IDLE, _CLOSED_LOOP = 1, 8
_VELOCITY, _POSITION = 2, 3
_PASSTHROUGH, _VEL_RAMP, _TRAP_TRAJ = 1, 2, 5
_STIFF_DPS2 = 1e4


@dataclass
class ODriveOptions:
    generation: str = "0.5"
    turns_per_table_turn: float = 1.0
    max_turns_per_s: float = 5.0
    unbalanced_dps: float = 0.0


@dataclass
class _Axis:
    plant: AxisPlant
    state: int = _IDLE
    error: int = 0
    ready: bool = True
    fed_s: float = 0.0
    pos_setpoint: float = 0.0
    under_way: bool = False
    """Whether the trapezoid that `t` planned has not ended: then the set point is where the motor is."""
    values: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def modes(self) -> tuple[int, int]:
        config = "controller.config."
        return int(self.values[config + "control_mode"]), int(self.values[config + "input_mode"])


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
        self.emit(self._clock.now())
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
                self.trip(axis, self._watchdog_bit)
        return []

    def fault(self, bits: int, motor: int = 0) -> None:
        self.trip(self.axes[motor], bits)

    def lose_encoder(self, motor: int = 0) -> None:
        self.axes[motor].ready = False
        self.trip(self.axes[motor], 0x100)

    def reboot(self) -> None:
        self._buffer = b""
        for axis in self.axes:
            axis.state, axis.error, axis.pos_setpoint, axis.under_way = _IDLE, 0, 0.0, False
            axis.values["config.enable_watchdog"] = 0.0
            axis.plant.spin(self._clock.now(), 0.0, _FRICTION_DPS2)

    def trip(self, axis: _Axis, bits: int) -> None:
        axis.error |= bits
        if axis.state != _IDLE:
            axis.state, axis.under_way = _IDLE, False
            axis.plant.spin(self._clock.now(), 0.0, _FRICTION_DPS2)

    # -------------------------------------------------------------------------------------------------------- parts

    @property
    def _watchdog_bit(self) -> int:
        return 0x800 if self.options.generation == "0.5" else 0x01000000

    def _expiry(self, axis: _Axis) -> float | None:
        """Checked in every state; what has expired is not said twice."""
        if axis.values["config.enable_watchdog"] and not axis.error & self._watchdog_bit:
            return axis.fed_s + axis.values["config.watchdog_timeout"]
        return None

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
        if command == "sc":
            for axis in self.axes:
                axis.error = 0
            return []
        return ["unknown command"]

    def _motor(self, axis: _Axis, command: str, numbers: list[float]) -> list[str]:
        now = self._clock.now()
        self._end_trajectory(axis, now)
        if command == "f":
            if not axis.ready:
                return ["0.000000 0.000000"]
            _, rate = axis.plant.state(now)
            return [f"{self._estimate(axis, now):.6f} {self._turns(rate):.6f}"]
        axis.fed_s = now
        if command == "u":
            return []
        if not numbers:
            return ["invalid command format"]
        values = axis.values
        if command == "v":
            values["controller.config.control_mode"] = float(_VELOCITY)
            values["controller.input_vel"] = numbers[0]
            self.ignored_velocities += axis.modes[1] == _TRAP_TRAJ
        elif command in ("t", "p"):
            values["controller.config.control_mode"] = float(_POSITION)
            values["controller.input_pos"] = float(np.float32(numbers[0]))
            if command == "t":
                values["controller.config.input_mode"] = float(_TRAP_TRAJ)
                self._plan(axis, now)
        self._drive(axis, now)
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
        now = self._clock.now()
        self._end_trajectory(axis, now)
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
        elif path == "controller.config.control_mode" and value >= _POSITION:
            self._synchronise(axis, now)
        elif path == "controller.input_pos" and axis.modes[1] == _TRAP_TRAJ:
            self._plan(axis, now)
        if path.startswith("controller."):
            self._drive(axis, now)
        return []

    def _property(self, axis: _Axis, path: str) -> str | None:
        old = self.options.generation == "0.5"
        if path == "current_state":
            return str(axis.state)
        if path == ("error" if old else "active_errors"):
            return str(axis.error)
        if old and path in ("motor.error", "controller.error"):
            return "0"
        if old and path in ("encoder.is_ready", "encoder.error"):
            return str(int(axis.ready if path.endswith("ready") else not axis.ready))
        if path == "controller.pos_setpoint":
            now = self._clock.now()
            return f"{self._estimate(axis, now) if axis.under_way else axis.pos_setpoint:.6f}"
        if path not in axis.values:
            return None
        value = axis.values[path]
        whole = path.endswith(("mode", "enable_watchdog", "state"))
        return str(int(value)) if whole else f"{value:.6f}"

    def _request_state(self, axis: _Axis, state: int) -> None:
        now = self._clock.now()
        if state == _CLOSED_LOOP:
            if axis.error or not axis.ready:
                return
            axis.state, axis.fed_s = _CLOSED_LOOP, now
            axis.pos_setpoint, axis.under_way = 0.0, False
            if axis.modes[0] >= _POSITION:
                self._synchronise(axis, now)
            self._drive(axis, now)
        elif state == _IDLE:
            axis.state, axis.under_way = _IDLE, False
            axis.plant.spin(now, 0.0, _FRICTION_DPS2)
        elif state == 11:
            axis.plant.set_zero(now)
            axis.state = _IDLE
        else:
            axis.error |= 0x1

    # ------------------------------------------------------------------------------------------------- the controller

    def _synchronise(self, axis: _Axis, now: float) -> None:
        """`Controller::control_mode_updated`."""
        axis.pos_setpoint = axis.values["controller.input_pos"] = self._estimate(axis, now)

    def _end_trajectory(self, axis: _Axis, now: float) -> None:
        if axis.under_way and not axis.plant.moving(now):
            axis.under_way = False
            axis.pos_setpoint = axis.values["controller.input_pos"]
            axis.values["controller.config.control_mode"] = float(_POSITION)

    def _plan(self, axis: _Axis, now: float) -> None:
        """`Controller::move_to_pos`: from the set point, wherever the motor is."""
        if axis.state != _CLOSED_LOOP:
            return
        rate, acceleration = (self._degrees(axis.values[f"trap_traj.config.{name}_limit"]) for name in ("vel", "accel"))
        planned = (self._degrees(axis.values["controller.input_pos"]), rate, acceleration)
        astray = not axis.under_way and abs(axis.pos_setpoint - self._estimate(axis, now)) > 1e-3
        pulled = (self._degrees(axis.pos_setpoint), self._fastest(axis), _STIFF_DPS2)
        axis.plant.move_through(now, (pulled, planned) if astray else (planned,))
        axis.under_way = True

    def _drive(self, axis: _Axis, now: float) -> None:
        """What the modes and set points make of the motor."""
        control, inputs = axis.modes
        if axis.state != _CLOSED_LOOP or (axis.under_way and inputs == _TRAP_TRAJ):
            return
        if axis.under_way:
            # The set point stays where the trapezoid had come to.
            axis.pos_setpoint, axis.under_way = self._estimate(axis, now), False
        if control == _VELOCITY:
            limit = self._fastest(axis)
            wanted = self._degrees(axis.values["controller.input_vel"]) if inputs in (_PASSTHROUGH, _VEL_RAMP) else 0.0
            ramp = self._degrees(axis.values["controller.config.vel_ramp_rate"]) if inputs == _VEL_RAMP else _STIFF_DPS2
            rate = min(max(wanted, -limit), limit) or self.options.unbalanced_dps
            axis.plant.spin(now, rate, ramp)
        elif control == _POSITION:
            if inputs == _PASSTHROUGH:
                axis.pos_setpoint = axis.values["controller.input_pos"]
            away = abs(axis.pos_setpoint - self._estimate(axis, now)) > 1e-3
            if away or axis.plant.moving(now):
                axis.plant.move_to(now, self._degrees(axis.pos_setpoint), self._fastest(axis), _STIFF_DPS2)

    def _fastest(self, axis: _Axis) -> float:
        return self._degrees(axis.values["controller.config.vel_limit"])

    def _estimate(self, axis: _Axis, now: float) -> float:
        return float(np.float32(self._turns(axis.plant.reading(now))))

    def _turns(self, degrees: float) -> float:
        return degrees / 360.0 * self.options.turns_per_table_turn

    def _degrees(self, turns: float) -> float:
        return turns * 360.0 / self.options.turns_per_table_turn
