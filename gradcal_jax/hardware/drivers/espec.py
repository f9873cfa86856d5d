"""ESPEC P-300 family chambers (P-300, SCP-220, ES-102, SH-241/641, EHS): ASCII lines, no check sum.

Sources: the vendor's ChamberConnectLibrary and the EHS manual's chapters on communication; a third party's SH-641
driver with its dialogue file. 8N1, CR LF both ways. A query is answered by a bare comma list, a command by `OK:` and
its echo, a refusal by `NA:` and a text. With RS-485 every command carries the prefix `address,`.

Unverified on real hardware: the pauses after commands (`set_pause_s`, `mode_pause_s`: what field drivers do, no
document states them); the blanks in the echo with an address (compared loosely); which set point `TEMP?` reports while
a remote ramp runs; whether `MODE,CONSTANT` ends a remote ramp on every model (the read-back decides). Product
temperature control needs an option of the chamber whose replies no source shows in full: `product_c` is None.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ..clock import Clock
from ..errors import FramingError, LimitExceeded, Rejected, ReplyTimeout, printable
from ..framing import LineFramer
from ..request_reply import Exchange, NotThisReply, command_and_verify
from ..roles import ChamberLimits, ChamberReading, Identity
from ..transport import Transport
from .base import ChamberDriver

Value = TypeVar("Value")

MODES = ("OFF", "STANDBY", "CONSTANT", "RUN")
DETAILED_MODES = (*MODES, "RUN PAUSE", "RUN END HOLD", "RMT RUN", "RMT RUN PAUSE", "RMT RUN END HOLD")
_CONDITIONING = {"CONSTANT", "RUN", "RUN END HOLD", "RMT RUN", "RMT RUN END HOLD"}
_RAMPING = {"RUN", "RMT RUN"}
_PROGRAM = set(DETAILED_MODES) - {"OFF", "STANDBY", "CONSTANT"}

REFUSALS = {
    "CMD ERR": "the chamber does not know this command",
    "ADDR ERR": "wrong address",
    "CONT NOT READY-1": "the chamber has no humidity or product temperature control",
    "CONT NOT READY-2": "no program is running",
    "CONT NOT READY-3": "this controller does not support it",
    "CONT NOT READY-4": "keys cannot be locked while the chamber is off",
    "CONT NOT READY-5": "the time signal is not enabled",
    "DATA NOT READY": "the program does not exist",
    "PARA ERR": "a parameter is wrong",
    "DATA OUT OF RANGE": "the value lies outside the limits set at the chamber",
    "PROTECT ON": "the chamber is write-protected at its panel",
    "INVALID REQ": "the request is not valid now",
    "CHB NOT READY": "the chamber is not ready",
}

_NUMBER = r"-?\d{1,3}(?:\.\d{1,2})?"
_TEMPERATURE = re.compile(rf"({_NUMBER}),({_NUMBER}),({_NUMBER}),({_NUMBER})")
_ALARMS = re.compile(r"\d+(,\d+)*")


@dataclass(frozen=True)
class EspecConfig:
    """Options of the rig file. `address` only on RS-485; `detailed_mode` off for SCP-220 controllers."""

    address: int | None = None
    baudrate: int = 9600
    detailed_mode: bool = True
    hardware_ramp: bool = True
    reply_timeout_s: float = 3.0
    query_pause_s: float = 0.1
    set_pause_s: float = 1.0
    mode_pause_s: float = 2.0
    lowest_plausible_c: float = -100.0
    highest_plausible_c: float = 250.0

    def __post_init__(self) -> None:
        if self.address is not None and not 1 <= self.address <= 16:
            raise ValueError(f"The chamber's address is {self.address}; RS-485 addresses are 1 to 16.")


@dataclass(frozen=True)
class ChamberTemperatures:
    """Reply to `TEMP?`, °C."""

    measured_c: float
    setpoint_c: float
    high_c: float
    low_c: float


def request(command: str, address: int | None = None) -> bytes:
    return (f"{address}," if address is not None else "").encode() + command.encode("ascii") + b"\r\n"


def reply_text(frame: bytes) -> str:
    """The text of a reply. Raises `Rejected` for `NA:`, `FramingError` for bytes that are no text."""
    if not all(32 <= byte < 127 for byte in frame):
        raise FramingError(f"The chamber answered {printable(frame)!r}, which is no text. Check the baud rate.")
    # Models differ in blanks around commas and in decimals, of which there are none to two.
    text = re.sub(r" *, *", ",", frame.decode("ascii").strip())
    if (refusal := re.match(r"NA\s*:\s*(.*)", text)) is not None:
        code = refusal[1].strip()
        meaning = REFUSALS.get(code, "see the chamber's manual")
        if code.startswith("PRGM WRITE ERR"):
            meaning = "the program cannot be written in this state"
        raise Rejected(f"The chamber refuses: {code} ({meaning}).", code=code, text=meaning)
    return text


def parse_temperatures(frame: bytes) -> ChamberTemperatures:
    match = _TEMPERATURE.fullmatch(reply_text(frame))
    if match is None:
        raise FramingError(f"TEMP? was answered {printable(frame)!r}; four temperatures were expected.")
    measured, setpoint, high, low = (float(field) for field in match.groups())
    return ChamberTemperatures(measured, setpoint, high, low)


def parse_mode(frame: bytes) -> str:
    text = reply_text(frame)
    if text not in DETAILED_MODES:
        raise FramingError(f"MODE? was answered {printable(frame)!r}, which is no mode of these chambers.")
    return text


def parse_alarms(frame: bytes) -> tuple[str, ...]:
    text = reply_text(frame)
    count, *codes = text.split(",") if _ALARMS.fullmatch(text) else ["?"]
    if not count.isdigit() or int(count) != len(codes):
        raise FramingError(f"ALARM? was answered {printable(frame)!r}; a count and that many codes were expected.")
    return tuple(codes)


def parse_type(frame: bytes) -> tuple[str, float]:
    """Controller type and highest temperature from `TYPE?`: `T,T,S2,160.0`, three fields without humidity."""
    fields = reply_text(frame).split(",")
    if len(fields) not in (3, 4) or re.fullmatch(_NUMBER, fields[-1]) is None:
        raise FramingError(f"TYPE? was answered {printable(frame)!r}; sensors, controller and a limit were expected.")
    return fields[-2], float(fields[-1])


def parse_acknowledgement(frame: bytes, command: str) -> None:
    """`OK:` and the echo, compared without blanks (with an address the echo is spaced differently)."""
    text = reply_text(frame)
    match = re.match(r"OK\s*:(.*)", text)
    if match is None:
        raise NotThisReply
    echo = match[1].replace(" ", "")
    if not echo.endswith(command.replace(" ", "")):
        raise FramingError(f"{command!r} was acknowledged as {printable(frame)!r}: another command, or a damaged line.")


def open_exchange(transport: Transport, clock: Clock, config: EspecConfig) -> Exchange:
    times_s = config.reply_timeout_s, config.query_pause_s
    return Exchange(transport, LineFramer(), clock, "The ESPEC chamber", *times_s)


class EspecChamber(ChamberDriver[EspecConfig]):
    """Role `Chamber`. One decimal everywhere; a hardware ramp is a remote one-step program of whole minutes."""

    _BOUNDS = "the chamber's alarm limits {low} to {high} degC. Change the plan, or the limits at the chamber's panel."

    def identify(self) -> Identity:
        try:
            controller, highest = self._ask("TYPE?", parse_type)
        except ReplyTimeout as silence:
            raise ReplyTimeout(
                f"{silence} If the chamber is on, set 'echo back' to ON in its communication menu: "
                "without it commands are answered only on demand."
            ) from None
        version = self._ask("ROM?", reply_text)
        return Identity("espec", controller, firmware=version, details={"highest temperature": f"{highest} degC"})

    def limits(self) -> ChamberLimits:
        now = self._ask("TEMP?", parse_temperatures)
        return ChamberLimits(now.low_c, now.high_c, 0.1, self._config.hardware_ramp, 0.01, ramp_step_s=60.0)

    def read(self) -> ChamberReading:
        temperatures = self._ask("TEMP?", parse_temperatures)
        time_s = self._clock.now()
        for value in (temperatures.measured_c, temperatures.setpoint_c):
            if not self._config.lowest_plausible_c <= value <= self._config.highest_plausible_c:
                raise FramingError(f"The chamber reports {value} degC, which is not plausible. Check line and sensor.")
        mode = self._mode()
        alarms = self._ask("ALARM?", parse_alarms)
        return ChamberReading(
            time_s, temperatures.measured_c, None, temperatures.setpoint_c, mode, mode in _CONDITIONING, alarms
        )

    def hold(self, temperature_c: float) -> None:
        self._check(round(temperature_c, 1))
        text = f"{temperature_c:.1f}"
        if self._mode() in _PROGRAM:
            self._set_mode("CONSTANT")
        command_and_verify(
            lambda: self._command(f"TEMP, S{text}"),
            lambda: self._ask("TEMP?", parse_temperatures),
            lambda shown: abs(shown.setpoint_c - float(text)) < 0.05,
            what=f"The set point {text} degC",
            clock=self._clock,
        )
        self._set_mode("CONSTANT")

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        """Start a ramp in the controller; returns the rate that whole minutes allow, K/min."""
        if not self._config.hardware_ramp:
            raise Rejected("Hardware ramps are switched off for this chamber in the rig file.")
        if not rate_k_per_min > 0.0:
            raise LimitExceeded(f"A ramp of {rate_k_per_min} K/min goes nowhere; give a rate above zero.")
        self._check(round(temperature_c, 1))
        now = self._ask("TEMP?", parse_temperatures)
        mode = self._mode()
        if mode in _PROGRAM:
            # End the old program first: its `RMT RUN` could look like the new one's.
            self.hold(min(max(now.measured_c, now.low_c), now.high_c))
            now, mode = self._ask("TEMP?", parse_temperatures), "CONSTANT"
        settled = mode == "CONSTANT" and abs(now.setpoint_c - now.measured_c) < 2.0
        start = now.setpoint_c if settled else now.measured_c
        minutes = max(1, round(abs(temperature_c - start) / rate_k_per_min))
        if minutes > 99 * 60 + 59:
            raise LimitExceeded(f"A ramp of {minutes} minutes is longer than the chamber's 99:59 hours.")
        # The order TEMP TIME GOTEMP is the vendor library's.
        step = f"RUN PRGM, TEMP{start:.1f} TIME{minutes // 60}:{minutes % 60:02d} GOTEMP{temperature_c:.1f}"
        wanted = _RAMPING if self._config.detailed_mode else {"RUN"}
        command_and_verify(
            lambda: self._command(step, self._config.mode_pause_s),
            self._mode,
            lambda mode: mode in wanted,
            what=f"The ramp to {temperature_c:.1f} degC",
            clock=self._clock,
            looks=1,
        )
        return abs(temperature_c - start) / minutes

    def standby(self) -> None:
        self._set_mode("STANDBY")

    def _air_c(self) -> float:
        return self._ask("TEMP?", parse_temperatures).measured_c

    def _mode(self) -> str:
        return self._ask("MODE?,DETAIL" if self._config.detailed_mode else "MODE?", parse_mode)

    def _set_mode(self, mode: str) -> None:
        if self._mode() != mode:
            command_and_verify(
                lambda: self._command(f"MODE,{mode}", self._config.mode_pause_s),
                self._mode,
                lambda shown: shown == mode,
                what=f"The mode {mode}",
                clock=self._clock,
            )

    def _ask(self, query: str, parse: Callable[[bytes], Value]) -> Value:
        def parse_query(frame: bytes) -> Value:
            # A late acknowledgement of an earlier command is not the answer to a question.
            if re.match(rb"OK\s*:", frame):
                raise NotThisReply
            return parse(frame)

        return self._exchange.query(request(query, self._config.address), parse_query)

    def _command(self, command: str, pause_s: float | None = None) -> None:
        self._exchange.query(
            request(command, self._config.address),
            lambda frame: parse_acknowledgement(frame, command),
            repeat=False,
            pause_after_s=self._config.set_pause_s if pause_s is None else pause_s,
        )
