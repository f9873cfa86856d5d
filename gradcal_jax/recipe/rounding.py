"""Rounding of a spec's plan to the controllers' steps, with its turns as the controllers' trapezoids.

Moves keep their order: a turn's duration is rounded up, so that its ramps do not exceed the limits, and the longest
standstill of the cycle becomes shorter by as much. An acceleration is the next step up, which may shorten the turn; the
longest standstill is longer by as much. A ramp's slope is rounded to the nearest step, or to the next slower one where
a repetition of the cycle would be lost. Whole turns stay whole. The axes' angles at rest are rounded, so that rounding
errors do not add up, and every pose is replaced by its turns.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from typing import Any, Final, cast

from gradcal_jax import units
from gradcal_jax.formulas import repetitions
from gradcal_jax.recipe.tracks import makeable_acceleration, trapezoid_acceleration
from gradcal_jax.spec.bench import Resolution
from gradcal_jax.spec.changes import differences, tables_of
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import PlanSchedule, Stretch, duration_of
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import ABSENT, dotted
from gradcal_jax.tables.section import Section

_HAIR: Final = Decimal("1e-6")  # of a step: rounding of the arithmetic, never of the plan
# Relative difference of accelerations that changes nothing of a turn.
_SAME_ACCELERATION: Final = 1e-3
_SHAPE: Final = "linear ramps"
# By kind of text: which of the steps, its dimension, the fewest steps of a value other than zero, and the way to round.
_KINDS: Final[Mapping[str, tuple[str, str, int, str]]] = {
    "temperature": ("temperature", "temperature", 0, ROUND_HALF_EVEN),
    "slope": ("slope", "temperature slope", 1, ROUND_HALF_EVEN),
    "slower slope": ("slope", "temperature slope", 1, ROUND_FLOOR),
    "time": ("time", "time", 1, ROUND_HALF_EVEN),
    "longer time": ("time", "time", 1, ROUND_CEILING),
    "rate": ("rate", "angular rate", 1, ROUND_HALF_EVEN),
    "angle": ("angle", "angle", 0, ROUND_HALF_EVEN),
}
Table = dict[str, Any]


class ControllerSteps(Section):
    """The steps of the controllers. The defaults suit this program's drivers; `[rig.resolution]` of a spec replaces
    them."""

    temperature: q.PositiveTemperatureDifference = q.Quantity(0.1, "0.1 K", "temperature difference")
    """Step of a temperature."""
    slope: q.PositiveTemperatureSlope = q.Quantity(0.01 / 60.0, "0.01 K/min", "temperature slope")
    """Step of a slope."""
    time: q.Time = q.Quantity(0.1, "0.1 s", "time")
    """Step of a duration."""
    rate: q.PositiveRate = q.Quantity(math.radians(0.01), "0.01 deg/s", "angular rate")
    """Step of a rate."""
    angle: q.Angle = q.Quantity(math.radians(0.001), "0.001 deg", "angle")
    """Step of an angle."""
    acceleration: q.PositiveAcceleration | None = None
    """Step of an acceleration; absent: accelerations are not rounded."""


# A rotary stage that counts accelerations in units of 10 000/1.6384 microsteps/s² has coarse steps: one that divides
# a turn into 1 152 000 microsteps makes 1.907, 3.815, … deg/s².
_ACCELERATION: Final = q.Quantity.read("1.9073486328125 deg/s^2", "angular acceleration")


def steps_of(spec: Spec) -> ControllerSteps:
    """The steps that a spec's `[rig.resolution]` gives, defaults for the others."""
    resolution = spec.rig.resolution or Resolution()
    names = ("temperature", "time", "rate", "angle", "acceleration")
    own = {name: value for name in names if (value := getattr(resolution, name)) is not None}
    return ControllerSteps(**{"acceleration": _ACCELERATION} | own)


@dataclass(frozen=True)
class Rounded:
    """`changes`: the changes by rounding, a sentence each; `notes`: deviations of the controllers from the plan."""

    spec: Spec
    changes: tuple[str, ...]
    notes: tuple[str, ...]


def rounded(spec: Spec, steps: ControllerSteps | None = None) -> Rounded:
    """The spec with a plan that the controllers can execute: turns become trapezoids ("linear ramps") of the same
    angle, peak rate and duration.

    Errors: `SpecError` where the rounded plan leaves a limit of the rig.
    """
    rounder = _Rounder(steps or steps_of(spec))
    tables = tables_of(spec)
    plan: Table = tables["plan"]
    if isinstance(spec.plan, StandardPlan):
        kinds = {"temperatures": "temperature", "soak": "longer time", "integration": "time", "rates": "rate"}
        rounder.entries(plan, **kinds)
        result = spec_of(tables)
    else:
        _temperatures(plan, rounder)
        if spec.plan.cycle is not None:
            _cycle(spec, spec.executable_schedule, plan["cycle"], rounder)
        result = _keep_cycles(spec, tables, rounder)
    changes: list[str] = []
    for key, before, after in differences(tables_of(spec)["plan"], tables_of(result)["plan"], ("plan",)):
        # A move that is as it was, but that it names the table's axis, is no change.
        was, now = cast("tuple[Table, Table]", (before, after))
        if not (isinstance(before, dict) and isinstance(after, dict) and {**was, "axis": now.get("axis")} == now):
            changes.append(f"{dotted(key)}: {_shown(before)} -> {_shown(after)}")
    return Rounded(result, tuple(changes), tuple(rounder.notes))


class _Rounder:
    """Rounds texts of quantities. A text on its grid is unchanged."""

    def __init__(self, steps: ControllerSteps) -> None:
        self.steps = steps
        self.acceleration = None if steps.acceleration is None else float(steps.acceleration)
        self.notes: list[str] = []
        names = [name for name in type(steps).model_fields if name != "acceleration"]
        split = {name: getattr(steps, name).text.split(" ", 1) for name in names}
        self._grid = {name: (Decimal(number), unit) for name, (number, unit) in split.items()}

    def to(self, name: str, value: float, way: str = ROUND_HALF_EVEN) -> str:
        """The text of the nearest multiple (or the next one up or down) of a step to an SI value."""
        step, unit = self._grid[name]
        count = self._count(name, value, way)
        shown = "degC" if name == "temperature" else unit
        return f"{format((count * step).normalize() + 0, 'f')} {shown}"

    def _count(self, name: str, value: float, way: str) -> Decimal:
        size = Decimal(repr(float(getattr(self.steps, name))))
        exact = Decimal(repr(value)) / size
        nearest = exact.to_integral_value(ROUND_HALF_EVEN)
        # A value on the grid except for its last digits stays there, whatever the direction of rounding.
        return nearest if abs(exact - nearest) <= _HAIR else exact.to_integral_value(way)

    def text(self, kind: str, text: str) -> str:
        """The rounded text of a quantity; `kind`: of `_KINDS`. A word such as "rest" stays."""
        if text.isalpha():
            return text
        name, dimension, least, way = _KINDS[kind]
        value = units.parse(text, dimension)
        count = self._count(name, value, way)
        size = float(getattr(self.steps, name))
        if value != 0.0 and abs(count) < least:
            return self.to(name, math.copysign(least * size, value))
        if abs(float(count) * size - value) <= 1e-9 * max(abs(value), size):
            return text
        return self.to(name, value, way)

    def entries(self, table: Table, /, **kinds: str) -> None:
        """Round these entries of a table, texts or lists of them, where it has them."""
        for key, kind in kinds.items():
            if isinstance(texts := table.get(key), list):
                table[key] = [self.text(kind, text) for text in cast("list[str]", texts)]
            elif key in table:
                table[key] = self.text(kind, table[key])

    def on_grid(self, angle: float) -> float:
        """The nearest multiple of the controllers' step, rad; whole turns stay whole."""
        turns = angle / (2.0 * math.pi)
        if abs(turns - round(turns)) <= 1e-9 * max(abs(turns), 1.0):
            return 2.0 * math.pi * round(turns)
        return units.parse(self.to("angle", angle), "angle")

    def note_shape(self, move: ResolvedMove) -> None:
        """Note a turn's shape where it is not the controllers'."""
        note = f'turns of shape "{move.shape}" are executed as trapezoids of the same angle, peak rate and duration'
        if move.shape != _SHAPE and note not in self.notes:
            self.notes.append(note)


# ------------------------------------------------------------------------------------------------- gradient method


def _keep_cycles(spec: Spec, tables: Table, rounder: _Rounder) -> Spec:
    """The spec of rounded tables, its slope the next slower one where a repetition of the cycle would be lost."""
    plan = tables["plan"]
    result, before = spec_of(tables), _cycles(spec)
    if _cycles(result) < before and isinstance(plan.get("gradient"), str):
        slope = rounder.text("slower slope", tables_of(spec)["plan"]["gradient"])
        again = spec_of({**tables, "plan": {**plan, "gradient": slope}})
        result = again if _cycles(again) > _cycles(result) else result
    if _cycles(result) < before:
        rounder.notes.append(f"after rounding, the plan has room for {_cycles(result)} cycles instead of {before}")
    return result


def _cycles(spec: Spec) -> int:
    return sum(stretch.cycles for stretch in spec.gradient_schedule.stretches)


def _temperatures(plan: Table, rounder: _Rounder) -> None:
    rounder.entries(plan, temperature="temperature", gradient="slope", soak="longer time")
    kinds = {"soak": "longer time", "rate": "slope"} | dict.fromkeys(("at", "ramp_to", "step_to"), "temperature")
    for item in plan.get("programme", ()):
        rounder.entries(item, **kinds)


def _cycle(spec: Spec, schedule: PlanSchedule, cycle: Table, rounder: _Rounder) -> None:
    """Every rest and turn of a cycle in full, and the axes' first angles."""
    axes = spec.rig.table.axis
    gyro = spec.sensor.gyro
    usable = math.inf if gyro is None else gyro.usable_rate or math.inf
    moves_of_file = tables_of(spec)["plan"]["cycle"]["moves"]
    rounder.entries(cycle.get("start", {}), **dict.fromkeys(cycle.get("start", {}), "angle"))
    moves: list[Table] = []
    before, at = list(schedule.start), [rounder.on_grid(angle) for angle in schedule.start]
    for step in schedule.steps:
        move, k = step.move, step.axis
        if k < 0:
            read = _reading_of(moves_of_file[step.source], rounder)
            moves.append({"rest": rounder.to("time", move.duration) if move.duration else "0 s"} | read)
            continue
        before[k] += move.angle
        kept = {"axis": axes[k].name} | _reading_of(moves_of_file[step.source], rounder)
        fastest = min(float(axes[k].max_rate), usable)
        steepest = float(axes[k].max_acceleration)
        if move.shape == "hand":
            turn = dict(moves_of_file[step.source])
            rounder.entries(turn, duration="time")
            moves.append(turn)
            at[k] += move.angle
            continue
        rounder.note_shape(move)
        angle = rounder.on_grid(before[k]) - at[k]
        if angle == 0.0:
            # Less than a step of the controller: no turn.
            moves.append({"rest": rounder.to("time", move.duration, ROUND_CEILING)})
            continue
        moves.append(_turn(angle, move, steepest, fastest, rounder) | kept)
        at[k] += units.parse(moves[-1]["turn"], "angle")
    cycle["moves"] = moves
    answer_s = float(spec.rig.table.answer_time)
    rounder.entries(cycle.get("other_axes", {}), duration="time", read_every="time")
    _keep_period(cycle, schedule.stretches, duration_of(schedule.steps), schedule.period, answer_s, rounder)


def _reading_of(move: Table, rounder: _Rounder) -> Table:
    """The keys of a rest or turn that say when it is read, as far as it has any."""
    read = {key: move[key] for key in ("read_every", "other_axes") if key in move}
    rounder.entries(read, read_every="time")
    return read


def _duration(move: Table) -> float:
    """Duration of a rest or turn, s."""
    return units.parse(move["rest" if "rest" in move else "duration"], "time")


def _keep_period(
    cycle: Table,
    stretches: Sequence[Stretch],
    own: float,
    period: float,
    answer_s: float,
    rounder: _Rounder,
) -> None:
    """Shorten the longest standstill by the time that rounding added, so that as many repetitions fit as before, or
    make it longer by the time that it took off the turns. `own`, `period`: of the planned cycle, the duration of
    its moves and of all of it, s; `answer_s`: the operator's time for each turn by hand."""
    rests = [(units.parse(move["rest"], "time"), move, "rest") for move in cycle["moves"] if "rest" in move]
    answers = answer_s * sum(move.get("shape") == "hand" for move in cycle["moves"])
    moving, others = math.fsum([answers, *(_duration(move) for move in cycle["moves"])]), 0.0
    if "other_axes" in cycle:
        other = cycle["other_axes"]
        others = units.parse(other["duration"], "time")
        rests.append((others, other, "duration"))
    over = moving + others - period
    if any(repetitions(s.duration, moving, period)[0] < s.cycles for s in stretches):
        # The moves themselves no longer fit at the end: the time of the other axes does not help.
        rests = [entry for entry in rests if entry[2] == "rest"]
        over = max(over, moving - own)
    if not rests:
        return
    longest, table, key = max(rests, key=lambda entry: entry[0])
    if abs(over) > 1e-9 * period and longest - over >= 2.0 * float(rounder.steps.time):
        table[key] = rounder.to("time", longest - over, ROUND_FLOOR)


def _turn(angle: float, move: ResolvedMove, steepest: float, fastest: float, rounder: _Rounder) -> Table:
    """A turn by `angle` with a move's peak rate and ramps, on the grids of angle, rate and time, no steeper than the
    table may."""
    peak = abs(move.peak_rate)
    ramp = peak / trapezoid_acceleration(move)
    turns = angle / (2.0 * math.pi)
    turned = rounder.to("angle", angle)
    if abs(turns - round(turns)) <= 1e-9 * abs(turns):
        turned = f"{360 * round(turns)} deg"
    elif units.parse(turned, "angle") == 0.0:
        turned = rounder.to("angle", math.copysign(float(rounder.steps.angle), turns))
    size = abs(units.parse(turned, "angle"))
    text = rounder.to("rate", peak)
    if units.parse(text, "angular rate") > fastest * (1.0 + 1e-9):
        text = rounder.to("rate", peak, ROUND_FLOOR)
    if units.parse(text, "angular rate") <= 0.0:
        text = rounder.to("rate", float(rounder.steps.rate))
    peak = units.parse(text, "angular rate")
    least = peak / steepest
    planned = peak / max(ramp, least)
    made = makeable_acceleration(planned, rounder.acceleration, steepest)
    if abs(made - planned) > _SAME_ACCELERATION * planned:
        ramp = least = peak / made
    duration_text = rounder.to("time", size / peak + max(ramp, least), ROUND_CEILING)
    duration = units.parse(duration_text, "time")
    if peak > 2.0 * size / duration:
        # Ramps only: the peak follows from angle and duration, one step lower where it is on the grid.
        text = rounder.to("rate", 2.0 * size / duration, ROUND_FLOOR)
        if units.parse(text, "angular rate") <= size / duration:
            text = units.format_quantity(2.0 * size / duration, "deg/s")
    return {"turn": turned, "peak_rate": text, "duration": duration_text, "shape": _SHAPE}


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        table = cast("Table", value)
        return "{ " + ", ".join(f"{name} = {_shown(entry)}" for name, entry in table.items()) + " }"
    if value is ABSENT:
        return "(absent)"
    if isinstance(value, list):
        return f"a list of {len(cast('list[Any]', value))}"
    return f"{value:g}" if isinstance(value, float) else str(value)
