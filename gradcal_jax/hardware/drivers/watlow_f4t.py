"""Watlow F4T controllers over Modbus TCP: TestEquity, ESPEC and other chambers since the F4 was discontinued.

Sources. Registers, their values and float order: ESPEC's ChamberConnectLibrary (watlowf4t.py). Part and serial number,
the low word first: Watlow's F4T user's guide, chapter 6. Ramps to a set point (2794, 2796, 2798): TestEquity's F4T
manual, chapter 4. A set point that is written while the control loop is off is accepted and ignored
(ChamberConnectLibrary, issue 11): so the loop is switched on first, and the read-back is the set point in force (2810),
not the written one (2782).

One loop, without cascade. Specific to a site, hence options: which `loop` is the temperature's; which profile event
switches the plant (`conditioning_event`); how many `alarms` there are. Temperatures must be in Celsius on this
interface. Unverified on real hardware: that a ramp begins at the set point in force; what a limit controller shows.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ..clock import Clock
from ..errors import FramingError, Rejected, printable
from ..framing import ModbusTcpFramer
from ..request_reply import Exchange, NotThisReply, command_and_verify
from ..roles import ChamberLimits, ChamberReading, Identity
from ..transport import Transport
from .base import ChamberDriver
from .watlow_f4 import exception_of

OFF, ON, AUTO = 62, 63, 10
CELSIUS, MINUTES, RAMP_AT_SET_POINT, RAMP_ALWAYS, TERMINATE = 15, 57, 85, 13, 148
UNITS, PROFILE_STATE, PROFILE_ACTION = 6730, 16568, 16566
PART_NUMBER, SERIAL_NUMBER, FIRMWARE = 16, 12, 4
# Of the first loop; those of the next lie 160 registers higher.
MODE, LOWEST, HIGHEST, SET_POINT = 2730, 2774, 2776, 2782
RAMP_ACTION, RAMP_SCALE, RAMP_RATE = 2794, 2796, 2798
IN_FORCE, MODE_IN_FORCE, PROCESS_VALUE = 2810, 2814, 2820
EVENTS = (16594, 16596, 16598, 16600, 16822, 16824, 16826, 16828)
_ALARM, _EACH_ALARM, _SILENT = 1356, 100, (88, 61, 12)
_MODES = {OFF: "OFF", AUTO: "AUTO", 54: "MANUAL"}
_PROFILES = {149: "PROFILE", 146: "PROFILE HELD"}
_FINEST_K = 0.01
_SLOWEST_K_PER_MIN, _FASTEST_K_PER_MIN = 0.01, 100.0


@dataclass(frozen=True)
class WatlowF4TConfig:
    """Options of the rig file. `conditioning_event` 0: no event switches the plant, the loop alone does."""

    address: int = 1
    baudrate: int = 9600
    reply_timeout_s: float = 1.0
    loop: int = 1
    conditioning_event: int = 0
    alarms: int = 6

    def __post_init__(self) -> None:
        for name, value, lowest, highest in (
            ("address", self.address, 0, 255),
            ("loop", self.loop, 1, 4),
            ("conditioning_event", self.conditioning_event, 0, len(EVENTS)),
            ("alarms", self.alarms, 0, 14),
        ):
            if not lowest <= value <= highest:
                raise ValueError(f"{name} is {value}; expected {lowest} to {highest}.")


def request(number: int, address: int, body: bytes) -> bytes:
    """A Modbus TCP message: its number, the length of what follows, the unit's address, function and data."""
    return struct.pack(">HHHB", number, 0, len(body) + 1, address) + body


def read_body(register: int, count: int) -> bytes:
    return struct.pack(">BHH", 3, register, count)


def write_body(register: int, words: tuple[int, ...]) -> bytes:
    return struct.pack(f">BHHB{len(words)}H", 16, register, len(words), 2 * len(words), *words)


def words_of(value: float) -> tuple[int, int]:
    """A float as two registers, the low word first."""
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return low, high


def float_of(words: tuple[int, ...]) -> float:
    (value,) = struct.unpack(">f", struct.pack(">HH", words[1], words[0]))
    return float(value)


def parse_reply(frame: bytes, sent: bytes) -> bytes:
    """The data of the reply to a message. Raises for an exception; ignores replies to other messages."""
    if frame[:2] != sent[:2] or frame[6] != sent[6] or frame[7] & 0x7F != sent[7]:
        raise NotThisReply
    if frame[7] & 0x80:
        raise exception_of(frame[8])
    return frame[8:]


def parse_words(frame: bytes, sent: bytes, count: int) -> tuple[int, ...]:
    """The registers of a reply to function 3, unsigned."""
    data = parse_reply(frame, sent)
    if len(data) != 1 + 2 * count or data[0] != 2 * count:
        raise FramingError(f"The reply {printable(frame)!r} does not hold {count} registers.")
    return struct.unpack(f">{count}H", data[1:])


def parse_written(frame: bytes, sent: bytes) -> None:
    """A write is acknowledged by its first register and their number."""
    if parse_reply(frame, sent) != sent[8:12]:
        raise FramingError(f"A write was acknowledged as {printable(frame)!r}; {printable(sent)!r} was sent.")


def open_exchange(transport: Transport, clock: Clock, config: WatlowF4TConfig) -> Exchange:
    return Exchange(transport, ModbusTcpFramer(), clock, "The Watlow F4T controller", config.reply_timeout_s)


class WatlowF4TChamber(ChamberDriver[WatlowF4TConfig]):
    """Role `Chamber`."""

    _BOUNDS = (
        "the controller's set point limits {low:g} to {high:g} degC. Change the plan, or the limits at the "
        "controller's setup page."
    )

    def __init__(self, exchange: Exchange, config: WatlowF4TConfig) -> None:
        super().__init__(exchange, config)
        self._number = 0
        self._above = 160 * (config.loop - 1)

    def identify(self) -> Identity:
        if self._word(UNITS) != CELSIUS:
            raise Rejected("The controller's Ethernet units are not Celsius. Set them to Celsius at its setup page.")
        part = "".join(chr(word & 0xFF) for word in self._words(PART_NUMBER, 15) if word & 0xFF).strip()
        low, high = self._words(SERIAL_NUMBER, 2)
        details = {"set point range": f"{self._float(LOWEST):g} to {self._float(HIGHEST):g} degC"}
        return Identity("watlow_f4t", part, str(high << 16 | low), str(self._word(FIRMWARE)), details)

    def limits(self) -> ChamberLimits:
        range_c = self._float(LOWEST), self._float(HIGHEST)
        return ChamberLimits(*range_c, _FINEST_K, True, _SLOWEST_K_PER_MIN, _FASTEST_K_PER_MIN)

    def read(self) -> ChamberReading:
        air = self._air_c()
        time_s = self._clock.now()
        mode, profile = self._word(MODE_IN_FORCE + self._above), self._word(PROFILE_STATE)
        alarms = tuple(
            f"alarm {number + 1}"
            for number in range(self._config.alarms)
            if self._word(_ALARM + _EACH_ALARM * number) not in _SILENT
        )
        event = self._config.conditioning_event
        runs = mode != OFF and (not event or self._word(EVENTS[event - 1]) == ON)
        shown = _PROFILES.get(profile) or _MODES.get(mode, f"mode {mode}")
        return ChamberReading(time_s, air, None, self._float(IN_FORCE), shown, runs, alarms)

    def hold(self, temperature_c: float) -> None:
        self._begin(temperature_c)
        if self._word(RAMP_ACTION + self._above) in (RAMP_AT_SET_POINT, RAMP_ALWAYS):
            self._write_word(RAMP_ACTION + self._above, OFF, "No ramp to the set point")
        self._write_float(SET_POINT, temperature_c, "The set point", IN_FORCE)

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        self._begin(temperature_c)
        self._write_float(RAMP_RATE, rate_k_per_min, "The rate of the ramp", RAMP_RATE)
        self._write_word(RAMP_SCALE + self._above, MINUTES, "The scale of the ramp")
        self._write_word(RAMP_ACTION + self._above, RAMP_AT_SET_POINT, "A ramp to the set point")
        self._write_float(SET_POINT, temperature_c, "The set point", SET_POINT)
        return rate_k_per_min

    def standby(self) -> None:
        self._condition(False)

    def _air_c(self) -> float:
        return self._float(PROCESS_VALUE)

    def _evidence(self, reading: ChamberReading) -> str:
        return f"{reading.mode}, set point {reading.setpoint_c:g} degC"

    def _begin(self, temperature_c: float) -> None:
        """The preconditions of a set point: it is allowed, no profile runs, and the loop is on."""
        self._check(temperature_c)
        state = partial(self._word, PROFILE_STATE)
        if state() in _PROFILES:
            self._shown(PROFILE_ACTION, (TERMINATE,), "The profile's end", state, lambda v: v not in _PROFILES)
        self._condition(True)

    def _condition(self, on: bool) -> None:
        if event := self._config.conditioning_event:
            self._write_word(EVENTS[event - 1], ON if on else OFF, f"Conditioning {'on' if on else 'off'}")
        wanted, mode = AUTO if on else OFF, partial(self._word, MODE_IN_FORCE + self._above)
        if on is not (mode() == AUTO):
            what = f"The control loop {'on (set points are ignored while it is off)' if on else 'off'}"
            self._shown(MODE + self._above, (wanted,), what, mode, lambda value: value == wanted)

    def _words(self, register: int, count: int = 1) -> tuple[int, ...]:
        sent = self._message(read_body(register, count))
        return self._exchange.query(sent, lambda frame: parse_words(frame, sent, count))

    def _word(self, register: int) -> int:
        return self._words(register)[0]

    def _float(self, register: int) -> float:
        return float_of(self._words(register + self._above, 2))

    def _write_word(self, register: int, value: int, what: str) -> None:
        self._shown(register, (value,), what, lambda: self._word(register), lambda shown: shown == value)

    def _write_float(self, register: int, value: float, what: str, shown_in: int) -> None:
        words, register = words_of(value), register + self._above
        what = f"{what} {value:g}"
        self._shown(register, words, what, lambda: self._float(shown_in), lambda shown: abs(shown - value) < 0.5e-3)

    def _shown(
        self,
        register: int,
        words: tuple[int, ...],
        what: str,
        read: Callable[[], float],
        shows: Callable[[float], bool],
    ) -> None:
        def send() -> None:
            sent = self._message(write_body(register, words))
            self._exchange.query(sent, lambda frame: parse_written(frame, sent), repeat=False)

        command_and_verify(send, read, shows, what=what, clock=self._clock)

    def _message(self, body: bytes) -> bytes:
        self._number = self._number % 0xFFFF + 1
        return request(self._number, self._config.address, body)
