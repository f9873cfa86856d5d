"""An axis that the operator turns: asked on a terminal, its angle typed there or read from an encoder.

The program writes a question without a line end, with a bell, and waits for a line:

    x: turn by +360 deg in 10 s, to 360 deg; let it come to rest and type the angle that its scale shows: 360.02 deg

An angle has its unit, by the grammar of all files (`359.975 deg` is valid, `360,02` is not), or `unit` is the unit of
bare numbers. The question is repeated for an invalid answer, and once for an angle further than `miss` from the goal. A
dial of one turn suffices: of the angles that look alike the nearest to the goal counts. With an encoder, Enter alone
means that it stands. So it does with `angle = "none"`, where nothing tells the angle, of a plan whose reference is
gravity: the reading is then the angle that was asked for.

The axis counts as moving from the question to the answer; a typed angle is one reading, at the time when its line
ended. The port is "terminal", where `gradcal run` was started, or any other with an operator: text with CR or LF at the
end of a line, and no echo by the program.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

from gradcal_jax import units
from gradcal_jax.hardware.clock import Clock, in_thread
from gradcal_jax.hardware.drivers.base import DriverOptions
from gradcal_jax.hardware.errors import Disconnected, HardwareError, LimitExceeded, Rejected
from gradcal_jax.hardware.roles import (
    AxisLimits,
    AxisReading,
    Identity,
    KeptSettings,
    MotionAxis,
    OperatorAsked,
    SafeReport,
)
from gradcal_jax.hardware.track import AxisCommand
from gradcal_jax.hardware.transport import TextLine
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import PositiveAcceleration, PositiveAngle, PositiveRate, Quantity, Time, Travel

_BELL = "\a"


class OperatorConfig(DriverOptions):
    """Options of the rig file."""

    role = "axis"
    max_rate: PositiveRate = Quantity.read("120 deg/s", "angular rate")
    """Largest rate of a turn by hand."""
    max_acceleration: PositiveAcceleration = Quantity.read("200 deg/s^2", "angular acceleration")
    """Largest acceleration of a turn by hand."""
    travel: Travel = Quantity(math.inf, "unlimited", "angle")
    """Travel in each direction from zero."""
    resolution: PositiveAngle = Quantity.read("0.01 deg", "angle")
    """Resolution of the scale."""
    miss: PositiveAngle = Quantity.read("5 deg", "angle")
    """Distance from the goal beyond which an answer is asked for again."""
    unit: str = ""
    """Unit of answers that have none."""
    angle: Literal["typed", "none"] = "typed"
    """Whether the operator types the angle, or nothing tells it."""
    remind: Time = Quantity(30.0, "30 s", "time")
    """Time after which a question rings again."""

    def _problems(self) -> Iterator[Problem]:
        try:
            units.parse(f"1 {self.unit or 'deg'}", "angle")
        except ValueError as problem:
            yield Problem(("unit",), str(problem), self.unit)

    def link(self, line: TextLine, clock: Clock) -> "Console":
        return Console(line, clock)

    def device(self, link: Any, clock: Clock, name: str = "", encoder: MotionAxis | None = None) -> "OperatorAxis":
        return OperatorAxis(link, self, clock, name, encoder)


def _deg(angle: float) -> float:
    return math.degrees(angle)


def angle_deg(text: str, unit: str = "") -> float:
    """A typed angle, deg. Raises `UnitError` with what was expected."""
    words = text.strip()
    if unit and words[-1:].isdigit():
        words = f"{words} {unit}"
    return units.to_unit(units.parse(words, "angle"), "deg")


def nearest_turn_deg(shown_deg: float, goal_deg: float) -> float:
    """The angle nearest to the goal that a dial of one turn shows as `shown_deg`."""
    return goal_deg + (shown_deg - goal_deg + 180.0) % 360.0 - 180.0


class Console:
    """One terminal, one question at a time. Lines without a question are ignored."""

    def __init__(self, line: TextLine, clock: Clock) -> None:
        self._line, self._clock = line, clock
        self._typed = b""
        self._answers: deque[tuple[str, float]] = deque()
        self._problem = ""
        self._listens = False
        self._open = False

    def ask(self, question: str) -> None:
        self._answers.clear()
        self._line.write(f"{_BELL}{question} ".encode())
        self._open = True
        if not self._listens:
            self._listens = True
            in_thread(self._listen, self._clock, lambda problem: None)

    def ring(self) -> None:
        self._line.write(_BELL.encode())

    def answer(self) -> tuple[str, float] | None:
        if self._problem:
            raise Disconnected(self._problem)
        if not (self._open and self._answers):
            return None
        self._open = False
        return self._answers.popleft()

    def withdraw(self, why: str) -> None:
        if self._open:
            self._open = False
            self._line.write(f"\r\n{why}\r\n".encode())

    def _listen(self) -> None:
        """Runs in a separate thread: the operator answers at any time, and the stamp is the time of the line's end."""
        while True:
            try:
                data, time_s = self._line.read_stamped(0.2)
            except HardwareError as problem:
                self._problem = str(problem)
                return
            self._typed += data
            *lines, self._typed = self._typed.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
            self._answers.extend((text.decode("utf-8", "replace"), time_s) for text in lines)


class OperatorAxis(MotionAxis):
    """Role `MotionAxis`. `name` is shown to the operator; `encoder` is an axis whose motor gets no commands."""

    def __init__(
        self, console: OperatorAsked, config: OperatorConfig, clock: Clock, name: str, encoder: MotionAxis | None = None
    ) -> None:
        self._console, self._config, self._clock, self._name = console, config, clock, name
        self._encoder = encoder
        self.settings = KeptSettings() if encoder is None else encoder.settings
        self._whole_turns_deg = 0.0
        self._goal_deg = 0.0
        self._question = ""
        self._ring_s = math.inf
        self._doubted = False
        # The newest reading confirmed by the operator; None: unknown.
        self._stands: AxisReading | None = None
        self._told = config.angle == "none"
        self._travel_deg, self._miss_deg = (_deg(angle) for angle in (config.travel, config.miss))

    def identify(self) -> Identity:
        if self._encoder is None:
            return Identity("operator", f"turned by hand, {'no angle' if self._told else 'angles typed'}")
        encoder = self._encoder.identify()
        return replace(encoder, driver="operator", model=f"turned by hand, encoder of {encoder.driver} {encoder.model}")

    def limits(self) -> AxisLimits:
        config, travel_deg = self._config, self._travel_deg
        ends = (None, None) if math.isinf(travel_deg) else (-travel_deg, travel_deg)
        grid = _deg(config.resolution) if self._encoder is None else self._encoder.limits().resolution_deg
        alone, most = self._encoder is None, (_deg(config.max_rate), _deg(config.max_acceleration))
        reads = {"typed": alone and not self._told, "told": alone and self._told}
        return AxisLimits(*most, *ends, grid, by_hand=True, **reads)

    def read(self) -> AxisReading:
        if self._question:
            self._hear()
        if self._encoder is not None:
            return replace(self._encoded(), moving=bool(self._question))
        if self._stands is None or self._question:
            return AxisReading(self._clock.now(), math.nan, 0.0, True, self._stands is not None, ())
        return self._stands

    def home(self) -> None:
        """Asks for the zero mark and returns at once: the readings show when the operator has answered."""
        self._goal_deg, self._stands, self._whole_turns_deg = 0.0, None, 0.0
        self._ask(f"{self._name}: bring it to its zero mark")

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        if abs(position_deg) > self._travel_deg + 1e-9:
            raise LimitExceeded(
                f"{position_deg:g} deg is outside the travel of {self._travel_deg:g} deg in each direction."
            )
        how = f"to {position_deg:.6g} deg"
        if self._stands is not None:
            angle = position_deg - self._goal_deg
            turn = AxisCommand(0.0, "", "turn", rate_dps=rate_dps, acceleration_dps2=acceleration_dps2, angle_deg=angle)
            how = f"by {angle:+.6g} deg in {turn.duration_s:.3g} s, {how}"
        self._goal_deg = position_deg
        self._ask(f"{self._name}: turn {how}")

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        raise Rejected(f"{self._name} is turned by hand, and a person cannot turn it at a constant rate.")

    def stop(self) -> None:
        """Withdraw the question (nothing drives the axis). The angle is unknown until the next answer."""
        if self._question:
            self._question, self._stands = "", None
            self._console.withdraw(f"{self._name}: cancelled: leave the axis where it is.")

    def safe(self, policy: str) -> SafeReport:
        self.stop()
        return SafeReport(True, "nothing drives the axis: it is where the operator left it")

    def _ask(self, what: str) -> None:
        enter = self._told or self._encoder is not None
        answer = "press Enter" if enter else "type the angle that its scale shows"
        self._question = f"{what}; let it come to rest and {answer}:"
        self._doubted = False
        self._ring_s = self._clock.now() + float(self._config.remind)
        self._console.ask(self._question)

    def _hear(self) -> None:
        answer = self._console.answer()
        if answer is None:
            if self._clock.now() >= self._ring_s:
                self._ring_s += float(self._config.remind)
                self._console.ring()
            return
        text, time_s = answer
        if (reading := self._understood(text, time_s)) is None:
            return
        away = abs(reading.position_deg - self._goal_deg)
        if away > self._miss_deg and not self._doubted:
            self._doubted = True
            again = "press Enter" if self._encoder is not None else "type it"
            self._console.ask(
                f"{self._name}: {reading.position_deg:.6g} deg differs by {away:.3g} deg from "
                f"{self._goal_deg:.6g} deg; correct the angle, or {again} again to confirm:"
            )
            return
        self._question, self._stands = "", reading

    def _understood(self, text: str, time_s: float) -> AxisReading | None:
        if (self._told or self._encoder is not None) and text.strip():
            why = "no angle is needed" if self._encoder is None else "the encoder measures the angle"
            self._console.ask(f"{self._name}: {why}; press Enter when the axis is at rest:")
            return None
        if self._encoder is not None:
            reading = self._encoder.read()
            turns = nearest_turn_deg(reading.position_deg, self._goal_deg) - reading.position_deg
            if self._stands is None:
                self._whole_turns_deg = turns
            return self._encoded()
        try:
            shown_deg = self._goal_deg if self._told else angle_deg(text, self._config.unit)
        except units.UnitError as problem:
            self._console.ask(f"{self._name}: {problem}. Type the angle that its scale shows:")
            return None
        return AxisReading(time_s, nearest_turn_deg(shown_deg, self._goal_deg), 0.0, False, True, ())

    def _encoded(self) -> AxisReading:
        """The encoder's reading, with whole turns counted from the zero mark."""
        assert self._encoder is not None
        reading = self._encoder.read()
        position = reading.position_deg + self._whole_turns_deg
        return replace(reading, position_deg=position, moving=False, referenced=True)
