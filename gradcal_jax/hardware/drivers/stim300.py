"""Sensonor / Safran STIM300 inertial units: binary datagrams, and Utility Mode for everything else.

Source: the official data sheet TS1524 rev. 31; the frames of a real unit agree. Datagrams are decoded in
`stim300_datagrams`. Utility Mode (`$name,parameters,check`) is the interface for machines; nothing is ever saved to the
flash memory. Bias trim and g-compensation alter the outputs: they are read and recorded.

The counter counts internal samples (2000 /s) modulo 256: at 125 samples/s it wraps every 16 samples. The host's clock
gives the number of whole wraps that are lost in a disturbed stretch.

Unverified on real hardware: that a unit already in Utility Mode answers the request with status 1; the codes of the
output units (`rate_unit_code`, `increment_unit_code`); non-standard baud rates on USB adapters.
"""

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from ..checksums import crc8_stim300
from ..clock import Clock
from ..errors import ChecksumError, FramingError, NotVerified, Rejected, ReplyTimeout, printable
from ..framing import LineFramer
from ..request_reply import Exchange, NotThisReply
from ..roles import Identity, ImuSettings
from ..settings import KeptSettings
from ..transport import Transport
from .base import ImuDriver
from .stim300_datagrams import CONTENTS, INTERNAL_RATE_HZ, LAYOUTS, Stim300Decoder

SAMPLE_RATE_CODES = {125.0: 0, 250.0: 1, 500.0: 2, 1000.0: 3, 2000.0: 4}
STATUS_TEXTS = {
    1: "invalid",
    2: "check failed",
    3: "unknown command",
    4: "wrong number of parameters",
    5: "invalid parameter",
    6: "too many saves",
    7: "save failed",
    8: "reduced to limits",
}


@dataclass(frozen=True)
class Stim300Config:
    """Options of the rig file. `datagram` is the code of `$sd`: 5 is rate, acceleration and temperature."""

    baudrate: int = 921600
    stopbits: Literal[1, 2] = 1
    parity: Literal["N", "E", "O"] = "N"
    sample_rate_hz: float = 125.0
    datagram: Annotated[int, Field(ge=0, lt=len(CONTENTS))] = 5
    increments: bool = False
    rate_unit_code: int = 0
    increment_unit_code: int = 1
    reply_timeout_s: float = 1.0
    mode_timeout_s: float = 3.0

    def __post_init__(self) -> None:
        if self.sample_rate_hz not in SAMPLE_RATE_CODES:
            raise ValueError(f"sample_rate is {self.sample_rate_hz:g} /s; the unit has 125, 250, 500, 1000, 2000.")
        bits = 1 + 8 + (self.parity != "N") + self.stopbits
        needed = 1.1 * bits * LAYOUTS[CONTENTS[self.datagram][1]].length * self.sample_rate_hz
        if self.baudrate < needed:
            raise ValueError(
                f"{self.sample_rate_hz:g} datagrams/s need {needed:.0f} bits/s and the line has {self.baudrate}: the "
                "unit would lose datagrams silently. Raise baudrate, lower sample_rate or choose a shorter datagram."
            )


def utility_request(name: str, *parameters: object) -> bytes:
    body = ",".join([f"${name}", *map(str, parameters)]) + ","
    return f"{body}{crc8_stim300(body.encode())}\r".encode("ascii")


def parse_utility(frame: bytes) -> tuple[str, list[str]]:
    """Name and fields of a reply whose check fits; raises `Rejected` for a status other than 0 and 8."""
    body, comma, check = frame[frame.find(b"#") :].rpartition(b",")
    if not comma or check != str(crc8_stim300(body + comma)).encode():
        raise ChecksumError(f"The reply {printable(frame)!r} fails its check. Check the line's shielding.")
    name, *fields = body.decode("ascii", "replace").removeprefix("#").split(",")
    if not fields or not fields[0].isdigit():
        raise FramingError(f"{printable(frame)!r} is no reply of Utility Mode.")
    status = int(fields[0])
    if status not in (0, 8):
        text = STATUS_TEXTS.get(status, "unknown status")
        raise Rejected(
            f"The unit refuses {name or 'the command'}: status {status} ({text}).", code=fields[0], text=text
        )
    return name, fields[1:]


def decoder_of(config: Stim300Config, registers: Mapping[str, str]) -> Stim300Decoder:
    """The decoder for a unit's configuration as it was read back: live, or later from a journal."""
    ranges = registers.get("irng", "").split(",")
    try:
        (range_g,) = {int(text) for text in ranges[3:6]}
    except ValueError:
        raise FramingError(
            f"The unit reports its ranges as {registers.get('irng')!r}; one accelerometer range was expected in the "
            "fourth to sixth field."
        ) from None
    return Stim300Decoder(
        sample_rate_hz=config.sample_rate_hz, acceleration_range_g=range_g, increments=config.increments
    )


class Stim300Stream(ImuDriver[Stim300Config]):
    """Role `ImuStream`."""

    def __init__(self, transport: Transport, clock: Clock, config: Stim300Config) -> None:
        super().__init__(Exchange(transport, LineFramer(b"\r"), clock, "The STIM300", config.reply_timeout_s), config)
        # Settings last until the unit is switched off, and are never saved.
        self.settings = KeptSettings()
        self._registers: dict[str, str] = {}
        self._in_utility = False

    def identify(self) -> Identity:
        self._enter_utility()
        return Identity("stim300", self._ask("ix")[0], self._ask("isn")[0], self._ask("ifw")[0])

    def configure(self) -> ImuSettings:
        self._enter_utility()
        config = self._config
        self._set("m", SAMPLE_RATE_CODES[config.sample_rate_hz])
        self._set("d", config.datagram)
        self._set("gu", config.increment_unit_code if config.increments else config.rate_unit_code)
        self._set("au", config.increment_unit_code if config.increments else config.rate_unit_code)
        registers: dict[str, str] = {}
        for name in ("id", "im", "it", "irng", "igu", "iau", "igf", "iaf", "ig", "ibto", "isv"):
            try:
                registers[name] = ",".join(self._ask(name))
            except Rejected as refusal:
                registers[name] = f"refused: {refusal.text}"
        self._registers = registers
        decoder_of(config, registers)
        return ImuSettings(config.sample_rate_hz, round(256 * config.sample_rate_hz / INTERNAL_RATE_HZ), registers)

    def start(self) -> None:
        if self._in_utility:
            self._ask("xn")
            self._in_utility = False

    def stop(self) -> None:
        self._enter_utility()

    def decoder(self) -> Stim300Decoder:
        if not self._registers:
            raise NotVerified("The unit's accelerometer range is not known yet: call configure() first.")
        return decoder_of(self._config, self._registers)

    def _enter_utility(self) -> None:
        if self._in_utility:
            return
        received = b""
        for _ in range(2):
            self._exchange.transport.write(b"UTILITYMODE\r")
            end = time.monotonic() + self._config.mode_timeout_s
            while (left := end - time.monotonic()) > 0.0:
                received = (received + self._exchange.transport.read(min(left, 0.1)))[-4096:]
                # A unit that a killed program left in Utility Mode calls the request invalid: `#,1,180`.
                if re.search(rb"#UTILITYMODE,234\r|#,1,180\r", received):
                    self._exchange.transport.drain(0.02)
                    self._in_utility = True
                    return
        raise (FramingError if received else ReplyTimeout)(
            f"The unit at {self._exchange.transport.url} was sent 'UTILITYMODE' and did not enter Utility Mode"
            + (f"; it sent {printable(received[-80:])!r}. Check that this is a STIM300 and" if received else ". Check")
            + " power, cable (RS-422), baud rate and parity."
        )

    def _ask(self, name: str, *parameters: object) -> list[str]:
        def parse(frame: bytes) -> list[str]:
            answered, fields = parse_utility(frame)
            if answered != name:
                raise NotThisReply
            return fields

        return self._exchange.query(utility_request(name, *parameters), parse)

    def _set(self, name: str, code: int) -> None:
        """Settings are idempotent: repeating after a lost reply is harmless; the read-back decides."""
        if self._ask(f"i{name}")[0] == str(code):
            return
        self._ask(f"s{name}", code)
        if (shown := self._ask(f"i{name}")[0]) != str(code):
            raise NotVerified(f"The unit got ${name} = {code} and reports {shown}.")
