"""The moves of a cycle: the keys of the file, and the motion that they define.

Kinematics (D duration, A peak rate, r ramp time, θ angle):

    shape        angle        peak acceleration     keys
    … ramps      A(D − r)     steepness·A/r         turn, peak_rate, duration
    hand         AD/2         largest slope         turn, duration, unevenness

The ramps and their steepness are those of `formulas.RAMPS`. A ramped turn is as fast as the axis allows, or as
`peak_rate` says, with ramps as short as the axis allows; its `duration` makes the ramps longer. Angle and duration are
exact, and a rounded `peak_rate` may differ by 0.5 %. Without a shape a turn has cosine ramps, and a short one need not
reach its `peak_rate`. A turn by hand lasts longer by the table's `answer_time`, half of it before and half of it after
turning.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import Discriminator, Field, Tag

from gradcal_jax import formulas
from gradcal_jax.spec.bench import Spacing, TableAxis
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Angle, Flag, Number, PositiveRate, Quantity, Text, Time
from gradcal_jax.tables.section import OneOf, Section, by_key, refuse

Axis = Literal["x", "y", "z"]
AXES: Final[tuple[Axis, ...]] = ("x", "y", "z")
FULL_TURN: Final = 2.0 * math.pi
_AGREEMENT: Final = 0.005
_ROUNDING: Final = 1e-9
_ALMOST: Final = 1.0 + 1e-6


@dataclass(frozen=True)
class ResolvedMove:
    """One move in SI, complete. Shape "rest" stands still for `duration`.

    `peak_rate` (rad/s, signed like `angle`) and the shape's parameters are those of
    `gradcal_jax.formulas.shape_pieces`.
    `fastest` and `peak_acceleration` are true maxima of the magnitude.
    `ramp` of a turn by hand is how long it stands before and after turning.
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
    unevenness: float = 0.0
    read_end: bool = True
    read_every: float | None = None
    other_axes: bool = False

    @property
    def is_rest(self) -> bool:
        """Whether the axis stands still."""
        return self.shape == "rest"

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
    read_every: (
        Annotated[
            Annotated[Literal["none"], Tag("<none>")] | Annotated[Spacing, Tag("<time>")],
            Discriminator(lambda value: "<none>" if value == "none" else "<time>"),
        ]
        | None
    ) = None
    """Time between readings during the move, counted from its start; "rest": one reading at its end; "none": no
    reading. Absent: a rest is read as the table is, a turn at its end."""

    @property
    def reading(self) -> dict[str, Any]:
        """The readings, as fields of a `ResolvedMove`."""
        every = self.read_every
        if isinstance(every, Quantity):
            return {"read_end": math.isinf(every), "read_every": float(every)}
        return {"read_end": every is None}


class Rest(_Move):
    """A rest: the table stands still."""

    rest: Time
    """Duration of the rest."""
    other_axes: Flag = False
    """Whether the table turns axes for other sensors during the rest."""

    def resolve(self) -> ResolvedMove:
        """The rest in SI."""
        duration = float(self.rest)
        return ResolvedMove("rest", duration, other_axes=self.other_axes, **self.reading)


class Turn(_Move):
    """A turn of one axis: at a constant rate between two ramps, or by hand, slow and uneven. The rate of a hand is
    A·½(1 − cos 2πu)·(1 + unevenness·sin 6πu) at the fraction u of the duration; only its ends are known."""

    turn: Angle
    """Angle of the turn; its sign is the direction."""
    axis: Text | None = None
    """Name of the table axis; may be absent if the table has only one."""
    shape: Annotated[str, OneOf(formulas.SHAPES)] | None = None
    """Shape of the rate over time; absent: cosine ramps, and a short turn need not reach its `peak_rate`."""
    peak_rate: PositiveRate | None = None
    """Largest rate; absent: the maximum rate of the axis."""
    duration: Time | None = None
    """Duration of the turn, ramps included; absent: the ramps are as short as the axis allows."""
    unevenness: Annotated[Number, Field(ge=0.0, lt=1.0)] = 0.3
    """Unevenness of a turn by hand, as a fraction of the rate."""

    def _problems(self) -> Iterator[Problem]:
        by_hand, every = self.shape == "hand", self.read_every
        spaced = isinstance(every, Quantity) and math.isfinite(every)
        timed, alone = self.duration is not None, self.peak_rate is None
        rules = (
            (self.turn == 0.0, "turn", "must not be zero; write a rest as { rest = … }"),
            (abs(self.turn) > 1e6 * FULL_TURN, "turn", "must be at most a million turns"),
            (by_hand and not timed, "duration", "this key is missing: how long does a hand take?"),
            (by_hand and not alone, "peak_rate", "has no effect on a turn by hand: leave this key out"),
            (by_hand and spaced, "read_every", "a turn by hand is known only at its ends: leave this key out"),
            (
                not by_hand and timed and alone,
                "peak_rate",
                "is missing: a duration alone does not determine the motion",
            ),
            (not by_hand and "unevenness" in self.model_fields_set, "unevenness", "is only for a turn by hand"),
        )
        for holds, key, message in rules:
            if holds:
                yield Problem((key,), message)

    @property
    def reading(self) -> dict[str, Any]:
        own = super().reading
        return own if math.isfinite(own.get("read_every", 0.0)) else {}

    def resolve(self, axis: TableAxis, answer_time: float) -> ResolvedMove:
        """The turn in SI; by hand with the operator's time (s) to read the request and to answer. Raises `SpecError`,
        keys relative to the move."""
        move, problems = self._by_hand(answer_time) if self.shape == "hand" else self._ramped(axis), list[Problem]()
        of = f'of axis "{axis.name}"'
        if (fastest := max(move.fastest, float(self.peak_rate or 0.0))) > axis.max_rate * _ALMOST:
            message = f"reaches {math.degrees(fastest):.5g} deg/s, which exceeds max_rate {of}, {axis.max_rate}"
            key = () if self.peak_rate is None else ("peak_rate",)
            problems.append(Problem(key, message, str(self.peak_rate or move.words)))
        if move.peak_acceleration > axis.max_acceleration * _ALMOST:
            message = f"accelerates at {math.degrees(move.peak_acceleration):.5g} deg/s^2, which exceeds "
            problems.append(Problem((), f"{message}max_acceleration {of}, {axis.max_acceleration}", move.words))
        refuse(*problems)
        return move

    def _ramped(self, axis: TableAxis) -> ResolvedMove:
        shape, angle = self.shape or "cosine ramps", float(self.turn)
        peak = float(axis.max_rate if self.peak_rate is None else self.peak_rate)
        steepness = formulas.RAMPS[shape].steepness
        if self.duration is None:
            # Without a flat part θ = A·ramp, ramp = least·A.
            least = steepness / float(axis.max_acceleration)
            reached = math.sqrt(abs(angle) / least)
            if self.shape is not None and self.peak_rate is not None and peak > reached * (1.0 + _ROUNDING):
                message = f"cannot be reached within {self.turn} at the table's max_acceleration; expected at most "
                refuse(Problem(("peak_rate",), f"{message}{math.degrees(reached):.4g} deg/s", str(self.peak_rate)))
            peak = min(peak, reached)
            ramp = least * peak
            duration = abs(angle) / peak + ramp
        else:
            duration, shortest = float(self.duration), abs(angle) / peak
            ramp = duration - shortest
            if not 0.0 < ramp <= 0.5 * duration * (1.0 + _AGREEMENT):
                message = (
                    f"contradicts turn and peak_rate, which need more than {shortest:.4g} s (without ramps) and at "
                    f"most {2.0 * shortest:.4g} s (if the turn consists of ramps only)"
                )
                refuse(Problem(("duration",), message, str(self.duration)))
            ramp = min(ramp, 0.5 * duration)
        return ResolvedMove(
            shape,
            duration,
            angle=angle,
            peak_rate=math.copysign(peak, angle),
            ramp=ramp,
            peak_acceleration=steepness * peak / ramp,
            fastest=peak,
            **self.reading,
        )

    def _by_hand(self, answer_time: float) -> ResolvedMove:
        angle, duration = float(self.turn), float(self.duration or 0.0)
        peak = 2.0 * angle / duration
        fastest, steepest = _uneven_maxima(self.unevenness)
        return ResolvedMove(
            "hand",
            duration + answer_time,
            angle=angle,
            peak_rate=peak,
            ramp=0.5 * answer_time,
            peak_acceleration=abs(peak) / duration * steepest,
            fastest=abs(peak) * fastest,
            unevenness=self.unevenness,
            **self.reading,
        )


class Pose(Section):
    """Move the named axes to these angles, one axis after the other, outermost first."""

    pose: dict[Text, Angle]
    """Angles that the named axes move to; other axes do not move."""
    peak_rate: PositiveRate | None = None
    """Largest rate of the moves; absent: the maximum rate of each axis."""
    rest: Time | None = None
    """Duration of the rest after the moves."""


# A pose may have a rest.
_EXPECTED: Final = 'a rest ("rest"), a turn ("turn", "axis") or a pose ("pose")'
Move = Annotated[Rest | Turn | Pose, by_key({"pose": Pose, "rest": Rest, "turn": Turn}, _EXPECTED)]


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
