"""ODrive motor controllers, firmware 0.5.x and 0.6.x: the ASCII protocol, with checksums.

Sources: ODrive's repository (documentation and firmware 0.5.6) and the enumerations of its 0.6.11 package. 115200 8N1.
A request that ends in `*` and the decimal exclusive or of its characters is answered with one; a damaged request
*gets no answer*. Commands of motion are never answered: the driver reads back the controller's input. An invalid
encoder estimate is printed as 0.0, so that readiness is queried with every position. `q` and `c` are not used.

**The controller's memory changes the effect of commands.** `t` plans from `pos_setpoint`, which velocity commands do
not change: after a spin the axis would first go back to the end of the last move, at the controller's `vel_limit`.
Writing `control_mode` as a property synchronises it. So before every `t` the mode is written, `pos_setpoint` and
estimate are read back, and the move is sent only if they agree. An `input_vel` of an earlier spin acts as soon as the
input mode allows it: it is set to zero before modes are changed. A velocity loop at zero yields to a load; therefore
the position loop holds an axis at rest.

**Watchdog**: fed by every motion command and by `heartbeat()`; its error stays until `sc`. When it expires the motor
goes idle and *coasts*: an unbalanced gimbal falls. `safe` switches it off, clears its error, and takes control again of
an axis that this program had powered. Errors at the beginning of a run are cleared (of both motors of a board) and
shown as warnings of every reading; recurring and later errors are faults.

Positions are float32: one step is 2⁻²³ of the value, 0.011 deg at 440 turns; `limits().resolution_deg` says it.

Unverified on real hardware: the property names, which change between versions of the firmware and are options
(`ready_property`, `error_property`, `input_velocity_property`, `input_position_property`, `setpoint_property`); that
generation 0.6 synchronises in the same way (the read-back decides). The position counts from where the encoder found
its index or was switched on: there is no homing by default (`home_state` 11 asks the controller to).
"""

import math
import re
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import AxisDriver, AxisOptions, codes_of
from gradcal_jax.hardware.errors import ChecksumError, DeviceFault, FramingError, NotVerified, Rejected, printable
from gradcal_jax.hardware.framing import LineFramer
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, AxisSafe, Identity, KeptSettings, SafeReport, travel_of
from gradcal_jax.hardware.transport import Transport

IDLE, CLOSED_LOOP = 1, 8
VELOCITY_RAMP, TRAPEZOID = 2, 5
VELOCITY_CONTROL, POSITION_CONTROL = 2, 3

_ERRORS = codes_of("odrive")
_REFUSALS = ("invalid command format", "invalid motor", "invalid property", "not implemented", "unknown command")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_STANDING_TURNS_PER_S = 1e-3
_SYNCHRONISED_DEG = 0.2
# Where a generation shows errors, and whether the encoder is valid (in 0.6 an error); the bit of an expired watchdog.
_GENERATIONS = {"0.5": ("error", "encoder.is_ready", 0x800), "0.6": ("active_errors", "", 0x01000000)}
_CONTROL_MODE, _INPUT_MODE = "controller.config.control_mode", "controller.config.input_mode"


@dataclass(frozen=True)
class ODriveConfig(AxisOptions):
    """Options of the rig file. `generation` is the firmware's, "0.5" or "0.6"; zero `watchdog_s`: no watchdog."""

    motor: Literal[0, 1] = 0
    generation: Literal["0.5", "0.6"] = "0.5"
    baudrate: int = 115200
    reply_timeout_s: float = 0.3
    watchdog_s: float = 1.0
    turns_per_table_turn: Annotated[float, Field(gt=0.0)] = 1.0
    max_rate_dps: float = 300.0
    max_acceleration_dps2: float = 300.0
    lowest_deg: float | None = None
    highest_deg: float | None = None
    in_position_deg: float = 0.05
    home_state: int = 0
    home_timeout_s: float = 60.0
    ready_property: str = ""
    error_property: str = ""
    input_velocity_property: str = "controller.input_vel"
    input_position_property: str = "controller.input_pos"
    setpoint_property: str = "controller.pos_setpoint"


def request(words: str) -> bytes:
    return f"{words}*{xor8(words.encode())}\n".encode("ascii")


def parse_line(frame: bytes) -> str:
    """Text of a reply with a right checksum. Raises `ChecksumError` also where there is none: it was requested."""
    body, star, check = frame.rpartition(b"*")
    if not star or check != str(xor8(body)).encode():
        raise ChecksumError(f"The reply {printable(frame)!r} has a wrong checksum. Check the line's shielding.")
    text = body.decode("ascii", "replace").strip()
    if text.startswith(_REFUSALS):
        raise Rejected(f"The controller refuses: {text}.")
    return text


def parse_numbers(frame: bytes, count: int = 1) -> list[float]:
    """One number of a property, or the position and velocity of the feedback."""
    texts = parse_line(frame).split(" ")
    if len(texts) != count or not all(map(_NUMBER.fullmatch, texts)):
        raise FramingError(f"The reply {printable(frame)!r} is not a list of {count} numbers.")
    return list(map(float, texts))


def decimal(value: float) -> str:
    """At most seven digits, never exponential: the controller reads `%f`."""
    text = f"{value:.7f}".rstrip("0").rstrip(".")
    return "0" if text in ("", "-0") else text


def open_exchange(transport: Transport, clock: Clock, config: ODriveConfig) -> Exchange:
    return Exchange(transport, LineFramer(), clock, "The ODrive controller", config.reply_timeout_s)


class ODriveAxis(AxisDriver[ODriveConfig]):
    """Role `MotionAxis`. Both motors of one board share an exchange."""

    def __init__(self, exchange: Exchange, config: ODriveConfig) -> None:
        super().__init__(exchange, config)
        errors_in, ready_in, self._watchdog_bit = _GENERATIONS[config.generation]
        self._errors_in, self._ready_in = config.error_property or errors_in, config.ready_property or ready_in
        self._target_turns: float | None = None
        self._spinning = False
        self._powered = False
        self._cleared: tuple[str, ...] = ()
        self.settings = KeptSettings(
            lambda name: decimal(self._property(name)),
            lambda name, value: self._set(name, float(value)),
            lambda shown, wanted: _near(float(shown), float(wanted)),
        )

    def identify(self) -> Identity:
        received = self._exchange.text(request("i"), self._config.reply_timeout_s, self._config.reply_timeout_s)
        texts = [parse_line(line) for line in re.split(rb"[\r\n]+", received) if line]
        if len(texts) != 3:
            raise FramingError(
                f"The controller at {self._exchange.transport.url} answered `i` with {printable(received)!r}; "
                "hardware, firmware and serial number were expected. Check port and baud rate."
            )
        values = [text.partition(":")[2].strip() or text for text in texts]
        return Identity("odrive", values[0], values[2], values[1])

    def limits(self) -> AxisLimits:
        config = self._config
        fastest = abs(self._property("controller.config.vel_limit")) * 360.0 / config.turns_per_table_turn
        ends = [abs(self._own(end)) for end in (config.lowest_deg, config.highest_deg) if end is not None]
        farthest = max([abs(self._feedback()[0]), *ends])
        most = min(config.max_rate_dps, fastest), config.max_acceleration_dps2
        step_deg = max(1e-6, _spacing(farthest)) * 360.0 / config.turns_per_table_turn
        return AxisLimits(*most, config.lowest_deg, config.highest_deg, step_deg, config.watchdog_s > 0.0)

    def read(self) -> AxisReading:
        config = self._config
        turns, turns_per_s = self._feedback()
        time_s = self._clock.now()
        errors = self._faults()
        ready = not self._ready_in or self._property(self._ready_in) != 0.0
        arrived = self._target_turns is None or abs(turns - self._target_turns) < self._units(config.in_position_deg)
        # A controller with an error does not drive the motor: no move is under way any more.
        driven = not errors and (self._spinning or not arrived)
        moving = abs(turns_per_s) >= _STANDING_TURNS_PER_S or driven
        rate = config.direction * turns_per_s * 360.0 / config.turns_per_table_turn
        faults = errors if ready else (*errors, "the encoder's position is not valid")
        return AxisReading(time_s, self._degrees(turns), rate, moving, ready, faults, self._cleared)

    def home(self) -> None:
        self._clear_errors()
        if self._config.home_state:
            self._go_idle(self._config.home_state, self._config.home_timeout_s, "homing")
        if faults := self.read().faults:
            raise DeviceFault(f"The axis has no valid reference: {', '.join(faults)}.")

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        config = self._config
        self._require_travel(position_deg, travel_of(config.lowest_deg, config.highest_deg))
        rate, acceleration = self._checked(rate_dps, acceleration_dps2)
        self._close_loop()
        if self.read().moving:
            self._brake()
        else:
            self._hold_here()
        for name, value in (("vel", rate), ("accel", acceleration), ("decel", acceleration)):
            self.settings.change(f"trap_traj.config.{name}_limit", decimal(value))
        turns = self._own(position_deg)
        self._spinning, self._target_turns = False, turns
        self.settings.note(_INPUT_MODE, str(TRAPEZOID))
        self._shown(f"t {config.motor} {decimal(turns)}", config.input_position_property, turns)

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        rate, acceleration = self._checked(abs(rate_dps), acceleration_dps2)
        self._close_loop()
        self._velocity(math.copysign(rate, rate_dps) * self._config.direction, acceleration)
        self._spinning, self._target_turns = True, None

    def stop(self) -> None:
        self._brake()
        if faults := self._faults():
            raise DeviceFault(f"The axis reports {', '.join(faults)} after stopping.")

    def heartbeat(self) -> None:
        if self._config.watchdog_s > 0.0:
            self._tell(f"u {self._config.motor}")

    def arm_watchdog(self) -> None:
        if self._config.watchdog_s > 0.0:
            self.settings.change("config.watchdog_timeout", decimal(self._config.watchdog_s))
            self._tell(f"u {self._config.motor}")
            self._set("config.enable_watchdog", 1.0)

    def safe(self, policy: AxisSafe) -> SafeReport:
        self._disarm_watchdog()
        expired = self._error_code() == self._watchdog_bit
        if expired:
            self._clear_errors()
        if policy is AxisSafe.UNPOWER:
            reading = self._brake()
            self._go_idle(IDLE, 2.0, "unpowering")
            held = True
        else:
            # An axis that this program has powered is held, also after an error; an idle axis stays idle.
            if self._powered or expired:
                self._close_loop()
            reading = self._brake()
            # The mode holds the angle: it is not restored.
            self.settings.before.pop(_CONTROL_MODE, None)
            held = not self._powered or self._state() == CLOSED_LOOP
        state = self._state()
        powered = "held by the position loop" if state == CLOSED_LOOP else "idle" if state == IDLE else f"state {state}"
        evidence = f"{reading.rate_dps:.3f} deg/s at {reading.position_deg:.3f} deg, {powered}"
        notes = (*reading.faults, *(f"cleared: {error}" for error in self._cleared))
        return SafeReport(policy.value, held and not reading.moving, "; ".join([evidence, *notes]))

    def _tell(self, words: str) -> None:
        self._exchange.write(request(words))

    def _property(self, path: str) -> float:
        return self._exchange.query(request(f"r axis{self._config.motor}.{path}"), parse_numbers)[0]

    def _feedback(self) -> list[float]:
        return self._exchange.query(request(f"f {self._config.motor}"), partial(parse_numbers, count=2))

    def _state(self) -> int:
        return int(self._property("current_state"))

    def _set(self, path: str, value: float) -> None:
        self._shown(f"w axis{self._config.motor}.{path} {decimal(value)}", path, value)

    def _shown(self, words: str, path: str, value: float) -> None:
        """Send a line that has no reply until the property shows it (the reply of a property has ten characters)."""
        self._verify(f"{words!r}", lambda: self._tell(words), lambda: self._property(path), lambda s: _near(s, value))

    def _error_code(self) -> int:
        return int(self._property(self._errors_in))

    def _faults(self) -> tuple[str, ...]:
        code = self._error_code()
        names = _ERRORS[self._config.generation]
        known = [f"{bit} ({text})" for bit, text in names.items() if code & int(bit, 16)]
        rest = code & ~sum(int(bit, 16) for bit in names)
        return tuple(known + ([f"0x{rest:x}"] if rest else []))

    def _clear_errors(self) -> None:
        """Show and clear the errors of an earlier session. Raises `DeviceFault` for recurring errors."""
        self._disarm_watchdog()
        if not (faults := self._faults()):
            return
        if self._config.generation == "0.5":
            codes = {part: int(self._property(f"{part}.error")) for part in ("motor", "encoder", "controller")}
            faults += tuple(f"{part} 0x{code:x}" for part, code in codes.items() if code)
        self._tell("sc")
        if self._faults():
            raise DeviceFault(
                f"The controller still reports {', '.join(faults)} after its errors were cleared. Remove the cause."
            )
        self._cleared = faults

    def _disarm_watchdog(self) -> None:
        if self._property("config.enable_watchdog"):
            self._set("config.enable_watchdog", 0.0)

    def _close_loop(self) -> None:
        if faults := self._faults():
            raise DeviceFault(f"The controller reports {', '.join(faults)}. Clear the cause and start again.")
        if self._state() != CLOSED_LOOP:
            # In position control the loop closes at the motor's position; at a velocity it would begin to turn.
            self._set(self._config.input_velocity_property, 0.0)
            self.settings.change(_CONTROL_MODE, str(POSITION_CONTROL))
            words = f"w axis{self._config.motor}.requested_state {CLOSED_LOOP}"
            self._verify("Closing the loop", lambda: self._tell(words), self._state, CLOSED_LOOP.__eq__, looks=10)
        self._powered = True

    def _go_idle(self, by: int, timeout_s: float, doing: str) -> None:
        """Request a state that ends in the idle one, or that, and wait."""
        self._tell(f"w axis{self._config.motor}.requested_state {by}")
        end = self._clock.now() + timeout_s
        while (seen := self._state()) != IDLE:
            if self._clock.now() > end:
                raise NotVerified(f"The controller is in state {seen} after {timeout_s:g} s of {doing}, not {IDLE}.")
            self._clock.sleep(self._POLL_S)

    def _velocity(self, turns_per_s: float, acceleration_turns: float) -> None:
        self.settings.change("controller.config.vel_ramp_rate", decimal(acceleration_turns))
        for _ in range(2):
            # A trapezoid that ends in between sets the control mode to position: hence twice, and verified.
            if (self._property(_CONTROL_MODE), self._property(_INPUT_MODE)) == (VELOCITY_CONTROL, VELOCITY_RAMP):
                break
            self._set(self._config.input_velocity_property, 0.0)
            self.settings.change(_CONTROL_MODE, str(VELOCITY_CONTROL))
            self.settings.change(_INPUT_MODE, str(VELOCITY_RAMP))
        words = f"v {self._config.motor} {decimal(turns_per_s)} 0"
        self._shown(words, self._config.input_velocity_property, turns_per_s)

    def _hold_here(self) -> None:
        """Hold the axis where it stands by the position loop. Raises where mode and set point are not verified."""
        path, tolerance = self._config.setpoint_property, self._units(_SYNCHRONISED_DEG)

        def astray() -> tuple[float, float]:
            return self._property(_CONTROL_MODE), self._property(path) - self._feedback()[0]

        self.settings.change(_CONTROL_MODE, str(POSITION_CONTROL))
        self._verify(
            "The command to hold the present position (read-back: control mode, and distance in turns from the present "
            "position to the set point)",
            lambda: self._tell(f"w axis{self._config.motor}.{_CONTROL_MODE} {POSITION_CONTROL}"),
            astray,
            lambda shown: shown[0] == POSITION_CONTROL and abs(shown[1]) <= tolerance,
        )

    def _brake(self) -> AxisReading:
        closed = self._state() == CLOSED_LOOP
        if closed:
            self._velocity(0.0, self._units(self._config.max_acceleration_dps2))
        self._spinning, self._target_turns = False, None
        reading = self._until_still(self._config.stop_timeout_s, "stopping", raise_faults=False)
        if closed and not reading.faults:
            self._hold_here()
        return reading

    def _checked(self, rate_dps: float, acceleration_dps2: float) -> tuple[float, float]:
        config = self._config
        self._require_motion(rate_dps, config.max_rate_dps, acceleration_dps2, config.max_acceleration_dps2)
        return self._units(rate_dps), self._units(acceleration_dps2)

    def _per_turn(self) -> float:
        return self._config.turns_per_table_turn


def _spacing(value: float) -> float:
    return float(np.spacing(np.float32(abs(value))))


def _near(shown: float, value: float) -> bool:
    """Equal to ten characters and float32."""
    return abs(shown - value) <= max(1e-5, 2.0 * _spacing(value))
