"""An axis that the operator turns: asked on a terminal, its angle typed there or read from an encoder.

The program writes a question without a line end, with a bell, and waits for a line:

    x: turn by +360 deg in 10 s, to 360 deg; let it come to rest and type the angle that its scale shows: 360.02 deg

An angle has its unit, by the grammar of all files (`359.975 deg` is valid, `360,02 deg` is not). The question is
repeated for an invalid answer, and once for an angle more than 5 deg from the goal. A dial of one turn suffices: of
the angles that look alike the nearest to the goal counts. With an encoder, Enter alone means that it stands. So it does
with `angle = "none"`, where nothing tells the angle, of a plan whose reference is gravity: the reading is then the
angle that was asked for.

The axis counts as moving from the question to the answer; a typed angle is one reading, at the time when its line
ended. The port is "terminal", where `gradcal run` was started, or any other with an operator: text with CR or LF at the
end of a line, and no echo by the program.
"""

import math
from collections import deque
from dataclasses import replace
from typing import Any, Literal

from gradcal_jax import units
from gradcal_jax.hardware.clock import Clock, in_thread
from gradcal_jax.hardware.drivers.base import DriverOptions, require_within
from gradcal_jax.hardware.errors import Disconnected, HardwareError, Rejected
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
from gradcal_jax.tables.quantity import PositiveAcceleration, PositiveRate, Quantity, Travel

_MISS_DEG = 5.0
_SCALE_DEG = 0.01
_LISTENS_S = 0.2


class OperatorConfig(DriverOptions):
    """Options of the rig file."""

    role = "axis"
    max_rate: PositiveRate = Quantity.read("120 deg/s", "angular rate")
    """Largest rate of a turn by hand."""
    max_acceleration: PositiveAcceleration = Quantity.read("200 deg/s^2", "angular acceleration")
    """Largest acceleration of a turn by hand."""
    travel: Travel = Quantity(math.inf, "unlimited", "angle")
    """Travel in each direction from zero."""
    angle: Literal["typed", "none"] = "typed"
    """Whether the operator types the angle, or nothing tells it."""

    def link(self, line: TextLine, clock: Clock) -> "Console":
        return Console(line, clock)

    def device(self, link: Any, clock: Clock, name: str = "", encoder: MotionAxis | None = None) -> "OperatorAxis":
        return OperatorAxis(link, self, clock, name, encoder)


class Console:
    """One terminal, one question at a time. Lines without a question are ignored."""

    def __init__(self, line: TextLine, clock: Clock) -> None:
        self._line, self._clock = line, clock
        self._typed = b""
        self._answers: deque[tuple[str, float]] = deque()
        self._problem = ""
        self._listens = self._open = False

    def ask(self, question: str) -> None:
        self._answers.clear()
        self._line.write(f"\a{question} ".encode())
        self._open = True
        if not self._listens:
            self._listens = True
            in_thread(self._listen, self._clock, lambda problem: None)

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
                data, time_s = self._line.read_stamped(_LISTENS_S)
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
        self._encoder, self._told = encoder, config.angle == "none"
        self._types = encoder is None and not self._told
        self.settings = KeptSettings() if encoder is None else encoder.settings
        self._whole_turns_deg = self._goal_deg = 0.0
        self._asked = self._doubted = False
        # The newest reading confirmed by the operator; None: unknown.
        self._stands: AxisReading | None = None

    def identify(self) -> Identity:
        if self._encoder is None:
            return Identity("operator", f"turned by hand, {'no angle' if self._told else 'angles typed'}")
        encoder = self._encoder.identify()
        return replace(encoder, driver="operator", model=f"turned by hand, encoder of {encoder.driver} {encoder.model}")

    def limits(self) -> AxisLimits:
        most = (self._config.max_rate, self._config.max_acceleration, self._config.travel)
        rate, acceleration, travel_deg = map(math.degrees, most)
        lowest, highest = (None, None) if math.isinf(travel_deg) else (-travel_deg, travel_deg)
        grid = _SCALE_DEG if self._encoder is None else self._encoder.limits().resolution_deg
        told = self._told and self._encoder is None
        return AxisLimits(rate, acceleration, lowest, highest, grid, by_hand=True, typed=self._types, told=told)

    def read(self) -> AxisReading:
        if self._asked:
            self._hear()
        if self._encoder is not None:
            return replace(self._encoded(), moving=self._asked)
        if self._stands is None or self._asked:
            return AxisReading(self._clock.now(), math.nan, 0.0, True, self._stands is not None, ())
        return self._stands

    def home(self) -> None:
        """Asks for the zero mark and returns at once: the readings show when the operator has answered."""
        self._goal_deg, self._stands, self._whole_turns_deg = 0.0, None, 0.0
        self._ask("bring it to its zero mark")

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        require_within(self.limits().beyond(rate_dps, acceleration_dps2, position_deg))
        how = f"to {position_deg:.6g} deg"
        if self._stands is not None:
            angle = position_deg - self._goal_deg
            turn = AxisCommand(0.0, "", "turn", rate_dps=rate_dps, acceleration_dps2=acceleration_dps2, angle_deg=angle)
            how = f"by {angle:+.6g} deg in {turn.duration_s:.3g} s, {how}"
        self._goal_deg = position_deg
        self._ask(f"turn {how}")

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        raise Rejected(f"{self._name} is turned by hand, and a person cannot turn it at a constant rate.")

    def stop(self) -> None:
        """Withdraw the question (nothing drives the axis). The angle is unknown until the next answer."""
        if self._asked:
            self._asked, self._stands = False, None
            self._console.withdraw(f"{self._name}: cancelled: leave the axis where it is.")

    def safe(self, policy: str) -> SafeReport:
        self.stop()
        return SafeReport(True, "nothing drives the axis: it is where the operator left it")

    def _ask(self, what: str) -> None:
        answer = "type the angle that its scale shows" if self._types else "press Enter"
        self._asked, self._doubted = True, False
        self._say(f"{what}; let it come to rest and {answer}:")

    def _say(self, what: str) -> None:
        self._console.ask(f"{self._name}: {what}")

    def _hear(self) -> None:
        answer = self._console.answer()
        if answer is None or (reading := self._understood(*answer)) is None:
            return
        away_deg = abs(reading.position_deg - self._goal_deg)
        if away_deg > _MISS_DEG and not self._doubted:
            self._doubted = True
            again = "type it" if self._types else "press Enter"
            self._say(
                f"{reading.position_deg:.6g} deg differs by {away_deg:.3g} deg from {self._goal_deg:.6g} deg; "
                f"correct the angle, or {again} again to confirm:"
            )
            return
        self._asked, self._stands = False, reading

    def _understood(self, text: str, time_s: float) -> AxisReading | None:
        """The reading of an answer; None: the operator is asked again."""
        if not self._types and text.strip():
            why = "no angle is needed" if self._encoder is None else "the encoder measures the angle"
            self._say(f"{why}; press Enter when the axis is at rest:")
            return None
        if self._encoder is not None:
            if self._stands is None:
                position_deg = self._encoder.read().position_deg
                self._whole_turns_deg = self._nearest_turn_deg(position_deg) - position_deg
            return self._encoded()
        position_deg = self._goal_deg
        if self._types:
            try:
                position_deg = self._nearest_turn_deg(math.degrees(units.parse(text, "angle")))
            except units.UnitError as problem:
                self._say(f"{problem}. Type the angle that its scale shows:")
                return None
        return AxisReading(time_s, position_deg, 0.0, False, True, ())

    def _nearest_turn_deg(self, shown_deg: float) -> float:
        """The angle nearest to the goal that a dial of one turn shows so."""
        return self._goal_deg + (shown_deg - self._goal_deg + 180.0) % 360.0 - 180.0

    def _encoded(self) -> AxisReading:
        """The encoder's reading, with whole turns counted from the zero mark."""
        assert self._encoder is not None
        reading = self._encoder.read()
        position = reading.position_deg + self._whole_turns_deg
        return replace(reading, position_deg=position, moving=False, referenced=True)
