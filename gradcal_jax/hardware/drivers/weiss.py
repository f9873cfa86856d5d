"""Weiss / Vötsch chambers with SIMCON/32 or S!MPAC (VC, VT, VTS, WK …): the ASCII-2 protocol, no checksum.

Sources: several independent public drivers and their tests, two captured self-descriptions, and a chamber's help text.
9600 8N1, address of two digits, CR. `$aaI` reads a fixed-width record whose layout differs from chamber to chamber;
`$aaE` writes *all* set points and *all* digital channels at once; `$aaU` sets gradients; `$aa?` describes the layout,
which the rig file gives for a chamber without a description. To write is to read, change temperature and start, and
write all other values unchanged.

The manual allows one string in five seconds (`min_interval_s`): more disturb the chamber's own control.

Unverified on real hardware: that `$aaU` is per minute (two sources agree, no manual page was seen); `$aaF`, the reply
to which no source shows (`read_faults`, off by default: then `alarms` is always empty and the rig needs another way to
notice a chamber alarm); records with 16 digital channels (`digital_channels`, one source); the acknowledgement, which
old controllers send (`0`) and new ones do not (both are accepted, the read-back decides).

**Neither a gradient nor the target of a ramp can be read back.** A lost `$E` leaves the chamber unchanged, a lost `$U`
makes it go as fast as it can, and a gradient stays in force after the run. But while a gradient runs the nominal value
of the record moves: a ramp counts as begun only when that moves at about the requested rate, and the command is
repeated otherwise. `hold`, `standby` and `safe` remove the gradient.
"""

import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

from pydantic import Field

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ChamberDriver
from gradcal_jax.hardware.errors import FramingError, LimitExceeded, NotVerified, Rejected, ReplyTimeout, printable
from gradcal_jax.hardware.framing import LineFramer, NotThisReply
from gradcal_jax.hardware.request_reply import TRIES, Exchange
from gradcal_jax.hardware.roles import ChamberLimits, ChamberReading, Identity
from gradcal_jax.hardware.transport import Transport

_NUMBER = re.compile(r"-?\d{1,5}\.\d")
_CHANNEL = re.compile(r"(?:CV|SV|MV|DO)\d\d")
_DEFINITION = re.compile(r"((?:CV|SV|MV|DO)\d\d)\s+(?!(?:CV|SV|MV|DO)\d)(.*[A-Za-z].*)")
_RANGE = re.compile(r"min\D*?(-?\d+(?:\.\d+)?)\D+?max\D*?(-?\d+(?:\.\d+)?)\s*(.*)", re.IGNORECASE)
# Change of a nominal value that counts as movement, and its uncertainty by resolution and time, K.
_MOVED_K, _HIDDEN_K = 0.25, 0.15


@dataclass(frozen=True)
class WeissConfig:
    """Options of the rig file. `read_layout`, `write_layout` (channel names, blanks between) only for a chamber that
    does not answer `$aa?`; with them `lowest_c` and `highest_c`."""

    address: Annotated[int, Field(ge=0, le=31)] = 1
    baudrate: int = 9600
    min_interval_s: float = 5.0
    reply_timeout_s: float = 5.0
    acknowledge_timeout_s: float = 1.0
    description_silence_s: float = 1.0
    temperature_channel: str = ""
    product_channel: str = ""
    start_channel: int = 1
    digital_channels: int = 32
    read_layout: str = ""
    write_layout: str = ""
    lowest_c: float = -70.0
    highest_c: float = 180.0
    hardware_ramp: bool = True
    read_faults: bool = False

    def __post_init__(self) -> None:
        if bool(self.read_layout) != bool(self.write_layout):
            raise ValueError("Give read_layout and write_layout together, or neither.")


@dataclass(frozen=True)
class Layout:
    """The meaning of a record's numbers. `read` and `write` are the numeric channels in the order of the line."""

    read: tuple[str, ...]
    write: tuple[str, ...]
    temperature: str
    lowest_c: float
    highest_c: float
    names: dict[str, str]

    def __post_init__(self) -> None:
        if self.read.count(self.temperature) != 2 or self.temperature not in self.write:
            raise ValueError(
                f"The temperature channel {self.temperature!r} must be twice in the read layout (nominal, actual) "
                f"and once in the write layout; the layouts are {' '.join(self.read)} and {' '.join(self.write)}."
            )
        if missing := [name for name in self.write if name not in self.read]:
            raise ValueError(f"Channels {' '.join(missing)} are written but never read; the layout cannot be correct.")

    def nominal(self, channel: str) -> int:
        """Position of the nominal value: the first of a channel's two numbers, or its only one."""
        return self.read.index(channel)

    def actual(self, channel: str) -> int:
        return len(self.read) - 1 - self.read[::-1].index(channel)


@dataclass(frozen=True)
class Record:
    """One `$aaI` record: numbers in the layout's order and the digital channels as text of 0 and 1."""

    numbers: tuple[float, ...]
    digital: str
    layout: Layout

    @property
    def nominal_c(self) -> float:
        return self.numbers[self.layout.nominal(self.layout.temperature)]

    @property
    def actual_c(self) -> float:
        return self.numbers[self.layout.actual(self.layout.temperature)]


def value_text(value: float) -> str:
    """Six characters, one decimal, a sign only when negative: `0023.4`, `-005.5`."""
    text = f"{value:06.1f}"
    if len(text) != 6:
        raise LimitExceeded(f"{value} does not fit the six characters of ASCII-2.")
    return "0000.0" if text == "-000.0" else text


def request(address: int, letter: str, body: str = "") -> bytes:
    return f"${address:02d}{letter}{' ' if body else ''}{body}\r".encode("ascii")


def write_body(record: Record, *, temperature_c: float, start: bool, start_channel: int) -> str:
    """The body of `$aaE`: the values of the record, except temperature and start."""
    layout = record.layout
    values = [
        temperature_c if name == layout.temperature else record.numbers[layout.nominal(name)] for name in layout.write
    ]
    digital = record.digital[:start_channel] + ("1" if start else "0") + record.digital[start_channel + 1 :]
    return " ".join([*map(value_text, values), digital])


def parse_record(frame: bytes, layout: Layout, digital_channels: int = 32) -> Record:
    *numbers, digital = frame.decode("ascii", "replace").strip().split(" ")
    if (
        len(numbers) != len(layout.read)
        or not all(len(text) >= 6 and _NUMBER.fullmatch(text) for text in numbers)
        or re.fullmatch(rf"[01]{{{digital_channels}}}", digital) is None
    ):
        raise FramingError(
            f"The chamber's record {printable(frame)!r} does not have {len(layout.read)} numbers and "
            f"{digital_channels} digital channels. Check the layout in the rig file."
        )
    return Record(tuple(map(float, numbers)), digital, layout)


def parse_description(text: str, temperature_channel: str = "") -> Layout:
    """The layout from the answer to `$aa?`.

    Old firmware separates `DO00 DO01`, new firmware joins them and breaks lines within a name: all blanks and line
    breaks of a template are removed before the search for names.

    Raises:
        FramingError: no templates, or no temperature channel with its range.
    """
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    definitions = [match for line in lines if (match := _DEFINITION.match(line))]
    # A template goes on to the first definition after it, or to the other template.
    marked = "\n".join("\0" if _DEFINITION.match(line) else line for line in lines)
    templates: dict[str, tuple[str, ...]] = {}
    for kind, other in ("EI", "IE"):
        _, *rest = re.split(rf"\b{kind}-?\s?string", marked, maxsplit=1, flags=re.I)
        if not rest:
            raise FramingError(
                "The chamber's description has no E-String and I-String. Write read_layout and write_layout in the rig "
                f"file; the chamber reported {printable(text.encode('ascii', 'replace'), 400)!r}."
            )
        template = re.split(rf"\0|\b{other}-?\s?string", rest[0], maxsplit=1, flags=re.I)[0]
        channels: list[str] = _CHANNEL.findall(re.sub(r"\s+", "", template))
        templates[kind] = tuple(name for name in channels if not name.startswith("DO"))
    names: dict[str, str] = {}
    ranges: dict[str, tuple[float, float]] = {}
    for match in definitions:
        limits = _RANGE.search(match[2])
        names[match[1]] = (limits[3] if limits else match[2]).strip()
        if limits:
            ranges[match[1]] = (float(limits[1]), float(limits[2]))
    channel = temperature_channel or next(
        (name for name, words in names.items() if name.startswith("CV") and "temp" in words.lower()), ""
    )
    if channel not in ranges:
        raise FramingError(
            f"The chamber's description names no temperature channel with a range (channels: {names}). "
            "Write temperature_channel, read_layout and write_layout in the rig file."
        )
    try:
        return Layout(templates["I"], templates["E"], channel, *ranges[channel], names)
    except ValueError as problem:
        raise FramingError(f"{problem} Write read_layout and write_layout in the rig file.") from None


def open_exchange(transport: Transport, clock: Clock, config: WeissConfig) -> Exchange:
    times_s = config.reply_timeout_s, config.min_interval_s
    return Exchange(transport, LineFramer(), clock, "The Weiss/Vötsch chamber", *times_s)


class WeissChamber(ChamberDriver[WeissConfig]):
    """Role `Chamber`. The first call that needs the layout reads it."""

    _BOUNDS = "the chamber's range {low} to {high} degC. Change the plan."

    def __init__(self, exchange: Exchange, config: WeissConfig) -> None:
        super().__init__(exchange, config)
        self._acknowledges = False
        self._orders = 0

    def identify(self) -> Identity:
        details = {"channels": " ".join(self._layout.read)} | self._layout.names
        return Identity("weiss", "ASCII-2 chamber", details=details)

    def limits(self) -> ChamberLimits:
        ends = self._layout.lowest_c, self._layout.highest_c
        return ChamberLimits(*ends, 0.1, self._config.hardware_ramp, 0.1, math.inf, 0.1)

    def read(self) -> ChamberReading:
        record = self._record()
        time_s, product, runs = self._clock.now(), self._config.product_channel, self._runs(record)
        product_c = record.numbers[record.layout.actual(product)] if product else None
        state = "RUN" if runs else "STOP", runs, self._faults()
        return ChamberReading(time_s, record.actual_c, product_c, record.nominal_c, *state)

    def hold(self, temperature_c: float) -> None:
        self._check(temperature_c)
        self._orders += 1
        self._write(temperature_c, start=True)

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        if not self._config.hardware_ramp:
            raise Rejected("Hardware ramps are switched off for this chamber in the rig file.")
        rate = round(rate_k_per_min, 1)
        if not rate > 0.0:
            raise LimitExceeded(f"{rate_k_per_min} K/min is below the chamber's resolution of 0.1 K/min.")
        self._check(temperature_c)
        self._orders += 1
        order, amiss = self._orders, ""
        before = self._record()
        start_c, runs = before.nominal_c, self._runs(before)
        for _ in range(TRIES):
            with self._exchange.alone():
                self._require_newest(order)
                if amiss:
                    # Begin at the first temperature: the chamber may be moving at full speed.
                    self._write(start_c, start=True)
                up, down = (rate, 0.0) if temperature_c >= start_c else (0.0, rate)
                self._tell(temperature_c, up, down, start=True)
            amiss = self._amiss(order, (self._clock.now(), start_c) if runs else None, temperature_c, rate)
            runs = True
            if not amiss:
                return rate
        raise NotVerified(
            f"A ramp to {temperature_c:.1f} degC at {rate:g} K/min was commanded {TRIES} times: {amiss}. Look at "
            "the chamber's display: it may be in local mode, or its gradients may be switched off."
        )

    def standby(self) -> None:
        self._orders += 1
        self._write(self._record().nominal_c, start=False)

    def _runs(self, record: Record) -> bool:
        return record.digital[self._config.start_channel] == "1"

    @cached_property
    def _layout(self) -> Layout:
        config = self._config
        if config.read_layout:
            reads, writes = config.read_layout.split(), config.write_layout.split()
            channel = config.temperature_channel or reads[0]
            return Layout(tuple(reads), tuple(writes), channel, config.lowest_c, config.highest_c, {})
        times_s = config.reply_timeout_s, config.description_silence_s
        received = self._exchange.text(self._request("?"), *times_s, longest_s=10.0)
        if not received:
            raise ReplyTimeout(
                f"The chamber at {self._exchange.transport.url} did not answer the request for its description ($aa?). "
                "Check address, baud rate and cable; if it has a fixed layout, write read_layout and write_layout in "
                "the rig file."
            )
        return parse_description(received.decode("ascii", "replace"), config.temperature_channel)

    def _record(self) -> Record:
        layout = self._layout

        def parse(frame: bytes) -> Record:
            if frame.strip() == b"0":
                raise NotThisReply  # a late acknowledgement
            record = parse_record(frame, layout, self._config.digital_channels)
            self._plausible(record.actual_c)
            return record

        return self._exchange.query(self._request("I"), parse)

    def _write(self, temperature_c: float, *, start: bool) -> None:
        """Set a temperature without a gradient: an old gradient stays active until it is overwritten."""

        def shows(now: Record) -> bool:
            return self._runs(now) == start and abs(now.nominal_c - float(value_text(temperature_c))) < 0.05

        what = f"Set point {temperature_c:.1f} degC with start {'on' if start else 'off'}"
        self._verify(what, lambda: self._tell(temperature_c, start=start), self._record, shows, looks=1)

    def _tell(self, temperature_c: float, up: float = 0.0, down: float = 0.0, *, start: bool) -> None:
        gradients, channel = " ".join(map(value_text, (up, down, 0.0, 0.0))), self._config.start_channel
        self._acknowledged("U", gradients)
        if not (up or down or self._acknowledges):
            # The removal of a gradient shows only at a large step of the set point.
            self._acknowledged("U", gradients)
        body = write_body(self._record(), temperature_c=temperature_c, start=start, start_channel=channel)
        self._acknowledged("E", body)

    def _require_newest(self, order: int) -> None:
        """Any other command ends the watch on a ramp's beginning at once."""
        if self._orders != order:
            raise NotVerified("The chamber received a different command before its ramp had begun.")

    def _amiss(self, order: int, begins: tuple[float, float] | None, target_c: float, rate_k_per_min: float) -> str:
        """Watch the nominal value until it has moved as expected: an empty text; else the deviation.

        `begins`: the time of the command, and the value then, which is unknown before a chamber runs.
        """
        until_s = self._clock.now() + 60.0 * (_MOVED_K + _HIDDEN_K) / rate_k_per_min + 3.0 * self._config.min_interval_s
        while True:
            self._require_newest(order)
            record = self._record()
            now_s, nominal = self._clock.now(), record.nominal_c
            if not self._runs(record):
                return "it is not started"
            arrived = abs(nominal - target_c) < 0.05
            if begins is None:
                begins = (now_s, record.actual_c if arrived else nominal)
            moved, took_s = abs(nominal - begins[1]), now_s - begins[0]
            if moved > 1.5 * rate_k_per_min * took_s / 60.0 + _HIDDEN_K:
                return f"its nominal value moved {moved:.1f} K in {took_s:.0f} s"
            if moved >= _MOVED_K or arrived:
                return ""
            if now_s > until_s:
                return f"its nominal value stays at {nominal:.1f} degC"
            self._clock.sleep(1.0)

    def _acknowledged(self, letter: str, body: str) -> None:
        """Send a command, again where an acknowledgement is missing that this chamber sends. `0` and silence both mean
        consent; the read-back decides."""

        def parse(frame: bytes) -> None:
            text = frame.decode("ascii", "replace").strip()
            if not text.isprintable() or "\ufffd" in text:
                raise FramingError(f"The chamber acknowledged ${letter} by {printable(frame)!r}. Check the line.")
            if text != "0":
                raise Rejected(f"The chamber refuses ${letter}: {text!r}.")

        for _ in range(TRIES):
            try:
                timeout_s = self._config.acknowledge_timeout_s
                self._exchange.query(self._request(letter, body), parse, repeat=False, reply_timeout_s=timeout_s)
                self._acknowledges = True
                return
            except (ReplyTimeout, FramingError):
                if not self._acknowledges:
                    return

    def _faults(self) -> tuple[str, ...]:
        if not self._config.read_faults:
            return ()
        text = self._exchange.query(self._request("F"), lambda frame: frame.decode("ascii", "replace").strip())
        return () if text in ("", "0") else (text,)

    def _request(self, letter: str, body: str = "") -> bytes:
        return request(self._config.address, letter, body)
