"""The moves of a cycle: the keys of the file, and the motion that they define.

Kinematics (D duration, A peak rate, r ramp time, θ angle):

    shape           angle        peak acceleration     keys
    cosine ramps    A(D − r)     πA/(2r)               turn|turns, peak_rate, duration, ramp
    linear ramps    A(D − r)     A/r                   turn|turns, peak_rate, duration, ramp
    hand            AD/2         largest slope         turn|turns, duration, unevenness

A turn by hand lasts longer by the table's `answer_time`, half of it before and half of it after turning.

The keys must determine the motion; with two keys for a ramped shape the ramps are as short as the table's largest
acceleration allows. More keys are allowed if they agree within 0.5 % (as rounded figures of a paper do); then angle and
duration are exact. The sign of the motion is that of `turn`; where the angle follows from the other keys, that of
`peak_rate`.
"""

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import Field

from gradcal_jax import formulas
from gradcal_jax.tables.problems import Problem, SpecError, one_of
from gradcal_jax.tables.quantity import Angle, Count, Flag, Number, Rate, Time
from gradcal_jax.tables.section import Section, choose, read_by, refuse, refuse_misspelt

Axis = Literal["x", "y", "z"]
AXES: Final[tuple[Axis, ...]] = ("x", "y", "z")
AGREEMENT: Final = 0.005
_ROUNDING: Final = 1e-9
FULL_TURN: Final = 2.0 * math.pi


@dataclass(frozen=True)
class ResolvedMove:
    """One move in SI, complete. Shape "rest" stands still for `duration`.

    `peak_rate` (rad/s, signed like `angle`) and the shape's parameters are those of
    `gradcal_jax.formulas.shape_pieces`.
    `fastest` and `peak_acceleration` are true maxima of the magnitude.
    `ramp` of a turn by hand is how long it stands before and after turning.
    `low` and `high` bound the angle during the move, from its start. The move is made `repeat` times.
    Readings are taken at the end (`read_end`), or every `read_every` seconds from the start, or both: of a rest that is
    read as its table is. `other_axes`: a rest during which the table is other axes'.
    """

    shape: str
    duration: float
    angle: float = 0.0
    peak_rate: float = 0.0
    ramp: float = 0.0
    peak_acceleration: float = 0.0
    fastest: float = 0.0
    low: float = 0.0
    high: float = 0.0
    unevenness: float = 0.0
    repeat: int = 1
    read_end: bool = True
    read_every: float | None = None
    other_axes: bool = False

    @property
    def is_rest(self) -> bool:
        """Whether the axis stands still."""
        return self.shape == "rest"

    def answered(self, answer_time: float) -> "ResolvedMove":
        """Of a turn by hand the one with the operator's time (s) to read the request and to answer; else the move."""
        if self.shape != "hand" or answer_time == 0.0:
            return self
        return replace(self, duration=self.duration + answer_time, ramp=0.5 * answer_time)

    @property
    def reads_as_table(self) -> bool:
        """Whether it is a rest that does not say when it is read."""
        return self.is_rest and self.read_every is None and self.read_end

    @property
    def words(self) -> str:
        """In words, for messages."""
        return f"{self.shape}, {self.duration:.4g} s"

    @property
    def readings(self) -> int:
        """Readings in one execution: at `k·read_every`, k = 1, 2, … ≤ duration/read_every, and the one at the end."""
        every = self.read_every
        if every is None or math.isinf(every):
            return int(self.read_end)
        count = formulas.reading_count(self.duration, every)
        return count + (self.read_end and count * every < self.duration * (1.0 - 1e-9))


class _Move(Section):
    repeat: Count = 1
    """Number of times that the move is made."""
    read: Literal["end", "none"] | None = None
    """"end": one reading at the end of the move; "none": no reading."""
    read_every: Time | None = None
    """Time between readings during the move, counted from its start; these readings replace the reading at the end of
    the move."""

    def _problems(self) -> Iterator[Problem]:
        if self.read is not None and self.read_every is not None:
            yield Problem(("read_every",), 'cannot be combined with "read"; keep one of them', self.read_every.text)

    @abstractmethod
    def resolve(self, max_acceleration: float) -> ResolvedMove:
        """The move in SI, complete. Raises `SpecError`, keys relative to the move."""

    def resolved(self, shape: str, duration: float, *, reach: float = 0.0, **motion: Any) -> ResolvedMove:
        """A motion that is made and read as it is written here; `reach`: how far it goes from its start."""
        end = self.read != "none" and self.read_every is None
        own: dict[str, Any] = {"read_end": end, "read_every": _number(self.read_every), "repeat": self.repeat}
        own |= {"low": min(0.0, reach), "high": max(0.0, reach)}
        return ResolvedMove(shape, duration, **own | motion)


class Rest(_Move):
    """A rest: the table stands still."""

    rest: Time
    """Duration of the rest."""
    other_axes: Flag = False
    """Whether the table turns axes for other sensors during the rest."""

    def resolve(self, max_acceleration: float) -> ResolvedMove:
        return self.resolved("rest", float(self.rest), other_axes=self.other_axes)


class Angled(Section):
    """An angle, written in one of two ways: `turn` or `turns`."""

    turn: Angle | None = None
    """Angle of the turn; its sign is the direction."""
    turns: Number | None = None
    """Number of revolutions instead of an angle; its sign is the direction."""

    def _problems(self) -> Iterator[Problem]:
        if self.turn is not None and self.turns is not None:
            yield Problem(("turns",), 'cannot be combined with "turn"; keep one of them', self.turns)
        elif self.turn == 0.0:
            yield Problem(("turn",), "must not be zero; write a rest as { rest = … }", "0")
        elif abs(self.turn or 0.0) > 1e6 * FULL_TURN:
            yield Problem(("turn",), "must be at most a million turns", str(self.turn))
        elif self.turns == 0.0 or abs(self.turns or 0.0) > 1e6:
            yield Problem(("turns",), "must not be zero, and must be at most a million turns", self.turns)

    @property
    def angle(self) -> float | None:
        """The angle of the file, in rad."""
        return FULL_TURN * self.turns if self.turns is not None else _number(self.turn)

    @property
    def angle_key(self) -> str:
        """The key that holds the angle."""
        return "turns" if self.turns is not None else "turn"


class _Turn(_Move, Angled):
    duration: Time | None = None
    """Duration of the turn, ramps included."""


class _RampedTurn(_Turn):
    SHAPE: ClassVar[str]
    # Peak acceleration times ramp, over peak rate.
    STEEPNESS: ClassVar[float]

    peak_rate: Rate | None = None
    """Largest rate. Its sign is the direction if there is neither `turn` nor `turns`."""
    ramp: Time | None = None
    """Time from rest to the peak rate; absent: as short as the table allows."""

    def _problems(self) -> Iterator[Problem]:
        peak = self.peak_rate
        if peak is not None and peak == 0.0:
            yield Problem(("peak_rate",), "must not be zero", peak.text)
        if peak is not None and peak < 0.0 and self.angle is not None:
            message = f'must be positive, because the sign of "{self.angle_key}" states the direction'
            yield Problem(("peak_rate",), message, peak.text)

    def resolve(self, max_acceleration: float) -> ResolvedMove:
        """Complete (θ, A, D, r) by θ = A(D − r)."""
        signed, fastest = self.angle, _number(self.peak_rate)
        direction = math.copysign(1.0, signed if signed is not None else fastest or 1.0)
        angle, peak = (None if value is None else abs(value) for value in (signed, fastest))
        duration, ramp = _number(self.duration), _number(self.ramp)
        if sum(value is not None for value in (angle, peak, duration)) < 2:
            message = "these keys do not determine the motion: give two of turn, peak_rate and duration "
            raise SpecError([Problem((), message + "(and optionally ramp)")])
        least = self.STEEPNESS / max_acceleration  # ramp time for each unit of peak rate
        if angle is not None and peak is not None and duration is not None:
            ramp = self._from_three(angle, peak, duration, ramp)
        elif angle is not None and peak is not None:
            ramp = ramp if ramp is not None else least * peak
            duration = angle / peak + ramp
            if ramp > (angle / peak) * (1.0 + _ROUNDING):
                self._too_fast(angle, peak, ramp, least)
        elif peak is not None and duration is not None:
            ramp = ramp if ramp is not None else least * peak
            if ramp > 0.5 * duration * (1.0 + _ROUNDING):
                self._too_short(2.0 * ramp)
            ramp = min(ramp, 0.5 * duration)
            angle = peak * (duration - ramp)
        else:
            assert angle is not None
            assert duration is not None
            if ramp is not None:
                if ramp > 0.5 * duration * (1.0 + _ROUNDING):
                    self._too_short(2.0 * ramp)
                peak = angle / (duration - ramp)
            else:
                # A(D − least·A) = θ; the smaller root, without cancellation
                discriminant = duration**2 - 4.0 * least * angle
                if discriminant < 0.0:
                    self._too_short(2.0 * math.sqrt(least * angle))
                peak = 2.0 * angle / (duration + math.sqrt(discriminant))
                ramp = least * peak
        turned, acceleration = direction * angle, self.STEEPNESS * peak / ramp
        sizes = {"ramp": ramp, "peak_acceleration": acceleration, "fastest": peak}
        return self.resolved(self.SHAPE, duration, reach=turned, angle=turned, peak_rate=direction * peak, **sizes)

    def _from_three(self, angle: float, peak: float, duration: float, ramp: float | None) -> float:
        fitting = duration - angle / peak
        if ramp is not None and abs(peak * (duration - ramp) - angle) > AGREEMENT * angle:
            turned = f"{math.degrees(peak * (duration - ramp)):.5g} deg"
            message = (
                f"contradicts the other keys: peak_rate × (duration − ramp) is {turned}; leave out one of the four keys"
            )
            raise SpecError([Problem((self.angle_key,), message, self._written_angle())])
        if fitting <= 0.0 or fitting > 0.5 * duration * (1.0 + AGREEMENT):
            shortest, longest = _seconds(angle / peak), _seconds(2.0 * angle / peak)
            message = (
                f"contradicts {self.angle_key} and peak_rate, which need more than {shortest} (without ramps) and "
                f"at most {longest} (if the turn consists of ramps only)"
            )
            raise SpecError([Problem(("duration",), message, str(self.duration))])
        return min(fitting, 0.5 * duration)

    def _too_fast(self, angle: float, peak: float, ramp: float, least: float) -> None:
        if self.ramp is not None:
            message = (
                f"is too long for {self._written_angle()} at {self.peak_rate}; expected at most "
                f"{_seconds(angle / peak)}"
            )
            refuse(Problem(("ramp",), message, self.ramp.text))
        message = f"cannot be reached within {self._written_angle()} at the table's max_acceleration; expected at most "
        fastest = math.degrees(math.sqrt(angle / least))
        refuse(Problem(("peak_rate",), f"{message}{fastest:.4g} deg/s", str(self.peak_rate)))

    def _too_short(self, needed: float) -> None:
        reason = "its two ramps" if self.ramp is not None else "the ramps at the table's max_acceleration"
        message = f"is too short for {reason}; expected at least {_seconds(needed)}"
        raise SpecError([Problem(("duration",), message, str(self.duration))])

    def _written_angle(self) -> str:
        return str(self.turn) if self.turn is not None else f"{self.turns:g} turns"


class CosineRamps(_RampedTurn):
    """A turn with constant rate between two half-cosine ramps (the paper's turn)."""

    SHAPE, STEEPNESS = "cosine ramps", math.pi / 2.0

    shape: Literal["cosine ramps"] = "cosine ramps"
    """Shape of the rate over time."""


class LinearRamps(_RampedTurn):
    """A turn with constant rate between two ramps of constant acceleration."""

    SHAPE, STEEPNESS = "linear ramps", 1.0

    shape: Literal["linear ramps"]
    """Shape of the rate over time."""


class Hand(_Turn):
    """A turn by hand, slow and uneven: the rate is A·½(1 − cos 2πu)·(1 + unevenness·sin 6πu) at the fraction u of the
    duration. Only its ends are known."""

    shape: Literal["hand"]
    """Shape of the rate over time."""
    unevenness: Annotated[Number, Field(ge=0.0, lt=1.0)] = 0.3
    """Unevenness of the turn, as a fraction of the rate."""

    def _problems(self) -> Iterator[Problem]:
        if self.read_every is not None:
            message = "the angle of a turn by hand is known only at its start and its end: leave this key out"
            yield Problem(("read_every",), message, self.read_every.text)

    def resolve(self, max_acceleration: float) -> ResolvedMove:
        angle = self.angle
        if angle is None or self.duration is None:
            missing = "turn" if angle is None else "duration"
            raise SpecError([Problem((missing,), "this key is missing: a turn by hand needs an angle and a duration")])
        peak, duration = 2.0 * angle / self.duration, float(self.duration)
        fastest, steepest = _uneven_maxima(self.unevenness)
        sizes = {"peak_acceleration": abs(peak) / duration * steepest, "fastest": abs(peak) * fastest}
        motion = {"angle": angle, "peak_rate": peak, "unevenness": self.unevenness, **sizes}
        return self.resolved("hand", duration, reach=angle, **motion)


Move = Annotated[Rest | CosineRamps | LinearRamps | Hand, read_by(lambda table: choose_move(table))]

SHAPES: Final[dict[str, type[Section]]] = {"cosine ramps": CosineRamps, "linear ramps": LinearRamps, "hand": Hand}


def choose_move(table: Mapping[str, object]) -> object:
    """The rest or turn of a table. Raises `SpecError` for one that is neither."""
    if "rest" in table:
        return Rest.model_validate(table)
    if "shape" not in table:
        refuse_misspelt(table, ["rest", "shape"])
        message = f'a move needs "rest" or a "shape", which is {one_of(SHAPES)}'
        raise SpecError([Problem(("shape",), message, kind="missing")])
    return choose(table, "shape", SHAPES)


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _uneven_maxima(unevenness: float) -> tuple[float, float]:
    """Largest rate over A, and largest acceleration over A/D, of the turn by hand; on a fine grid."""
    fastest = steepest = 0.0
    tau = 2.0 * math.pi
    for i in range(2001):
        u = i / 2000.0
        bell, ripple = 0.5 * (1.0 - math.cos(tau * u)), 1.0 + unevenness * math.sin(3.0 * tau * u)
        slope = 0.5 * tau * math.sin(tau * u) * ripple + bell * unevenness * 3.0 * tau * math.cos(3.0 * tau * u)
        fastest, steepest = max(fastest, bell * ripple), max(steepest, abs(slope))
    return fastest, steepest


def _seconds(value: float) -> str:
    return f"{value:.4g} s"
