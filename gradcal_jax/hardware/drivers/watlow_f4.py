"""Watlow F4 (F4S, F4D) controllers over Modbus RTU: TestEquity and many re-badged chambers.

Source: the vendor-class ChamberConnectLibrary; a third party's driver shows the same frames. 8N1, functions 3 and 6,
CRC-16, at least 30 ms between frames. Set points and process values are 16-bit integers times a power of ten given by
register 606. The driver works in static mode (register 300) and never saves to the EEPROM, whose writes are limited;
the runner makes ramps in steps (`hardware_ramp` is False), because a ramp in the controller means editing a stored
profile.

Specific to a site, hence options: which event output switches the conditioning (`conditioning_event`), which digital
input is the limit controller's contact (`limit_input`), which analogue input measures the product (`product_input`).
Unverified on real hardware: the behaviour with decimals other than 0 and 1; that `model_register` holds the model.
"""

from collections.abc import Callable
from dataclasses import dataclass

from ..checksums import crc16_modbus
from ..clock import Clock
from ..errors import ChecksumError, FramingError, Rejected, printable
from ..framing import ModbusReplyFramer
from ..request_reply import Exchange, NotThisReply, command_and_verify
from ..roles import ChamberLimits, ChamberReading, ChamberSafe, Identity
from ..transport import Transport
from .base import ChamberDriver

EXCEPTIONS = {1: "function", 2: "register address", 3: "value", 4: "device failure", 5: "acknowledged", 6: "busy"}

STATUS, SET_POINT, UNITS, TERMINATE, PROFILE_SET_POINT = 200, 300, 901, 1217, 4122
DECIMALS = {1: 606, 2: 616, 3: 626}
PROCESS_VALUE = {1: 100, 2: 104, 3: 108}
SET_POINT_LOW, SET_POINT_HIGH = 602, 603
_MODES = {0: "STATIC", 1: "STATIC", 2: "PROFILE", 3: "PROFILE HELD"}


@dataclass(frozen=True)
class WatlowF4Config:
    """Options of the rig file. Zero in `conditioning_event`, `limit_input` and `product_input`: there is none."""

    address: int = 1
    baudrate: int = 9600
    reply_timeout_s: float = 0.5
    min_interval_s: float = 0.03
    conditioning_event: int = 0
    limit_input: int = 0
    limit_input_tripped: int = 1
    product_input: int = 0
    model_register: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.address <= 247:
            raise ValueError(f"The controller's address is {self.address}; Modbus addresses are 1 to 247.")
        for name, value, highest in (
            ("conditioning_event", self.conditioning_event, 8),
            ("limit_input", self.limit_input, 4),
        ):
            if not 0 <= value <= highest:
                raise ValueError(f"{name} is {value}; the F4 numbers them 1 to {highest}, 0 means none.")
        if self.product_input not in (0, 2, 3):
            raise ValueError(f"product_input is {self.product_input}; it is 2 or 3, 0 means none.")

    def lacks_for(self, safe: str) -> str:
        """What a safe state needs and these options lack, empty where nothing."""
        if safe != ChamberSafe.STANDBY.value or self.conditioning_event:
            return ""
        return (
            'an event output switches the plant of an F4: name it as conditioning_event, or choose "ambient" or "hold"'
        )


def _frame(body: bytes) -> bytes:
    return body + crc16_modbus(body)


def read_request(address: int, register: int, count: int = 1) -> bytes:
    return _frame(bytes([address, 3]) + register.to_bytes(2, "big") + count.to_bytes(2, "big"))


def write_request(address: int, register: int, value: int) -> bytes:
    return _frame(bytes([address, 6]) + register.to_bytes(2, "big") + (value & 0xFFFF).to_bytes(2, "big"))


def _checked(frame: bytes, address: int, function: int) -> bytes:
    """Body of a sound reply to `function`; raises for a wrong CRC, an exception, another slave's reply."""
    if len(frame) < 5 or crc16_modbus(frame[:-2]) != frame[-2:]:
        raise ChecksumError(f"The reply {frame.hex(' ')} fails its CRC. Check the line's shielding and termination.")
    if frame[0] != address or frame[1] & 0x7F != function:
        raise NotThisReply
    if frame[1] & 0x80:
        raise exception_of(frame[2])
    return frame[2:-2]


def exception_of(code: int) -> Rejected:
    """The error for a Modbus exception."""
    meaning = EXCEPTIONS.get(code, "unknown")
    return Rejected(f"The controller refuses: exception {code} ({meaning}).", code=str(code), text=meaning)


def parse_registers(frame: bytes, address: int, count: int) -> tuple[int, ...]:
    """Signed 16-bit values of a reply to function 3."""
    body = _checked(frame, address, 3)
    if body[0] != 2 * count or len(body) != 1 + 2 * count:
        raise FramingError(f"The reply {frame.hex(' ')} does not hold {count} registers.")
    return tuple(int.from_bytes(body[i : i + 2], "big", signed=True) for i in range(1, len(body), 2))


def parse_echo(frame: bytes, sent: bytes) -> None:
    """A write is acknowledged by its own echo."""
    _checked(frame, sent[0], 6)
    if frame != sent:
        raise FramingError(f"A write was echoed as {printable(frame)!r}; {printable(sent)!r} was sent.")


def with_decimals(raw: int, decimals: int) -> float:
    return raw / 10**decimals


def unscaled(value: float, decimals: int) -> int:
    return round(value * 10**decimals)


def open_exchange(transport: Transport, clock: Clock, config: WatlowF4Config) -> Exchange:
    times_s = config.reply_timeout_s, config.min_interval_s
    return Exchange(transport, ModbusReplyFramer(config.address), clock, "The Watlow F4 controller", *times_s)


class WatlowF4Chamber(ChamberDriver[WatlowF4Config]):
    """Role `Chamber`."""

    _BOUNDS = (
        "the controller's set point limits {low} to {high} degC. Change the plan, or the limits at the controller's "
        "setup page."
    )

    def __init__(self, exchange: Exchange, config: WatlowF4Config) -> None:
        super().__init__(exchange, config)
        self._decimals: dict[int, int] = {}

    def identify(self) -> Identity:
        (unit,) = self._read(UNITS)
        if unit != 1:
            raise Rejected("The controller is set to degrees Fahrenheit. Set it to Celsius at its setup page.")
        limits = self.limits()
        range_c = f"{limits.lowest_c} to {limits.highest_c} degC"
        details = {"decimals of input 1": str(self._places(1)), "set point range": range_c}
        (model,) = self._read(self._config.model_register)
        return Identity("watlow_f4", f"model register {model}", details=details)

    def limits(self) -> ChamberLimits:
        low, high = self._read(SET_POINT_LOW, 2)
        places = self._places(1)
        range_c = with_decimals(low, places), with_decimals(high, places)
        return ChamberLimits(*range_c, 10.0**-places, hardware_ramp=False)

    def read(self) -> ChamberReading:
        air = self._air_c()
        time_s = self._clock.now()
        (status,) = self._read(STATUS)
        set_point = self._temperature(PROFILE_SET_POINT if status in (2, 3) else SET_POINT, 1)
        product = self._config.product_input
        conditioning = True
        if self._config.conditioning_event:
            conditioning = self._read(self._event_register())[0] != 0
        alarms: tuple[str, ...] = ()
        if self._config.limit_input:
            (state,) = self._read(201 + 12 * (self._config.limit_input - 1))
            if state == self._config.limit_input_tripped:
                alarms = (f"limit input {self._config.limit_input}",)
        product_c = self._temperature(PROCESS_VALUE[product], product) if product else None
        mode = _MODES.get(status, f"status {status}")
        return ChamberReading(time_s, air, product_c, set_point, mode, conditioning, alarms)

    def hold(self, temperature_c: float) -> None:
        self._check(temperature_c)
        if self._read(STATUS)[0] in (2, 3):
            self._write_shown(TERMINATE, 1, "The end of the running profile", STATUS, lambda value: value in (0, 1))
        raw = unscaled(temperature_c, self._places(1))
        self._write_shown(SET_POINT, raw, f"The set point {temperature_c:.1f} degC", SET_POINT, lambda v: v == raw)
        self._condition(True)

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        raise Rejected("This driver has no ramp in the controller: the runner steps the set point.")

    def standby(self) -> None:
        if lack := self._config.lacks_for(ChamberSafe.STANDBY.value):
            raise Rejected(f"This F4 cannot be put into standby: {lack}.")
        self._condition(False)

    def _air_c(self) -> float:
        return self._temperature(PROCESS_VALUE[1], 1)

    def _evidence(self, reading: ChamberReading) -> str:
        state = "conditioning" if reading.conditioning else "conditioning off"
        return f"{reading.mode}, {state}, set point {reading.setpoint_c} degC"

    def _read(self, register: int, count: int = 1) -> tuple[int, ...]:
        address = self._config.address
        return self._exchange.query(
            read_request(address, register, count), lambda frame: parse_registers(frame, address, count)
        )

    def _write_shown(self, register: int, value: int, what: str, shown_in: int, shows: Callable[[int], bool]) -> None:
        sent = write_request(self._config.address, register, value)
        command_and_verify(
            lambda: self._exchange.query(sent, lambda frame: parse_echo(frame, sent), repeat=False),
            lambda: self._read(shown_in)[0],
            shows,
            what=what,
            clock=self._clock,
        )

    def _places(self, sensor: int) -> int:
        if sensor not in self._decimals:
            (places,) = self._read(DECIMALS[sensor])
            if not 0 <= places <= 3:
                raise FramingError(f"The controller reports {places} decimals of input {sensor}; 0 to 3 were expected.")
            self._decimals[sensor] = places
        return self._decimals[sensor]

    def _temperature(self, register: int, sensor: int) -> float:
        return with_decimals(self._read(register)[0], self._places(sensor))

    def _event_register(self) -> int:
        return 2000 + 10 * (self._config.conditioning_event - 1)

    def _condition(self, on: bool) -> None:
        if self._config.conditioning_event:
            register, value = self._event_register(), int(on)
            self._write_shown(
                register, value, f"Conditioning {'on' if on else 'off'}", register, lambda shown: shown == value
            )
