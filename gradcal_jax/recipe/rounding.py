"""Rounding of a spec's plan to the controllers' steps, with its turns as the controllers' trapezoids.

Moves keep their order: a turn's duration is rounded up, so that its ramps do not exceed the limits, and the longest
standstill of the cycle becomes shorter by as much. An acceleration is the next step up, which may shorten the turn; the
longest standstill is longer by as much. A ramp's slope is rounded to the nearest step, or to the next slower one where
a repetition of the cycle would be lost. Whole turns stay whole. The axes' angles at rest are rounded, so that rounding
errors do not add up, and every pose is replaced by its turns.
"""

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from typing import Any, Final, NamedTuple, cast

from gradcal_jax import units
from gradcal_jax.formulas import repetitions
from gradcal_jax.recipe.tracks import ControllerSteps, makeable_acceleration, steps_of, trapezoid_acceleration
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import PlanSchedule, duration_of
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity

_HAIR: Final = Decimal("1e-6")  # of a step: rounding of the arithmetic, never of the plan
# Relative difference of accelerations that changes nothing of a turn.
_SAME_ACCELERATION: Final = 1e-3
_SHAPE: Final = "linear ramps"
_DIMENSIONS: Final = {
    "temperature": "temperature", "slope": "temperature slope", "time": "time", "rate": "angular rate",
    "angle": "angle",
}  # fmt: skip
_KINDS: Final = {
    "temperature": "temperature", "at": "temperature", "ramp_to": "temperature", "step_to": "temperature",
    "temperatures": "temperature", "gradient": "slope", "soak": "time", "integration": "time", "duration": "time",
    "read_every": "time", "rates": "rate",
}  # fmt: skip
"""The step of each key of a plan."""
Table = dict[str, Any]


class Rounded(NamedTuple):
    """`notes`: deviations of the controllers from the plan."""

    spec: Spec
    notes: tuple[str, ...]


def rounded(spec: Spec, steps: ControllerSteps | None = None) -> Rounded:
    """The spec with a plan that the controllers can execute: turns become trapezoids ("linear ramps") of the same
    angle, peak rate and duration.

    Errors: `SpecError` where the rounded plan leaves a limit of the rig.
    """
    rounder = _Rounder(steps or steps_of(spec))
    tables = tables_of(spec)
    plan: Table = tables["plan"]
    rounder.entries(plan)
    if isinstance(spec.plan, StandardPlan):
        return Rounded(spec_of(tables), ())
    for item in plan.get("programme", ()):
        rounder.entries(item, rate="slope")
    if spec.plan.cycle is not None:
        rounder.cycle(spec, spec.executable_schedule, plan["cycle"])
    result, before = spec_of(tables), _cycles(spec)
    if _cycles(result) < before and isinstance(plan.get("gradient"), str):
        # The next slower slope, where a repetition of the cycle would be lost.
        slope = rounder.text("slope", tables_of(spec)["plan"]["gradient"], ROUND_FLOOR)
        again = spec_of({**tables, "plan": {**plan, "gradient": slope}})
        result = again if _cycles(again) > _cycles(result) else result
    notes = list(rounder.notes)
    if _cycles(result) < before:
        notes.append(f"after rounding, the plan has room for {_cycles(result)} cycles instead of {before}")
    return Rounded(result, tuple(notes))


def _cycles(spec: Spec) -> int:
    return sum(stretch.cycles for stretch in spec.gradient_schedule.stretches)


class _Rounder:
    """Rounds quantities. A text on its grid is unchanged."""

    def __init__(self, steps: ControllerSteps) -> None:
        self.steps = steps
        self.notes: dict[str, None] = {}

    def to(self, name: str, value: float, way: str = ROUND_HALF_EVEN) -> Quantity:
        """The nearest multiple (or the next one up or down) of a step to an SI value."""
        step: Quantity = getattr(self.steps, name)
        number, unit = step.text.split(" ", 1)
        exact = Decimal(repr(value)) / Decimal(repr(float(step)))
        count = exact.to_integral_value(ROUND_HALF_EVEN)
        # A value on the grid except for its last digits stays there, whatever the direction of rounding.
        count = count if abs(exact - count) <= _HAIR else exact.to_integral_value(way)
        text = format((count * Decimal(number)).normalize() + 0, "f")
        return Quantity.read(f"{text} {'degC' if name == 'temperature' else unit}", _DIMENSIONS[name])

    def text(self, name: str, text: str, way: str = ROUND_HALF_EVEN) -> str:
        """The rounded text of a quantity; a word such as "rest" stays, and nothing but temperatures and angles becomes
        zero."""
        if text.isalpha():
            return text
        step, value = float(getattr(self.steps, name)), units.parse(text, _DIMENSIONS[name])
        found = self.to(name, value, way)
        if value and not found and name not in ("temperature", "angle"):
            found = self.to(name, math.copysign(step, value))
        return text if abs(found - value) <= 1e-9 * max(abs(value), step) else found.text

    def entries(self, table: Table, **kinds: str) -> None:
        """Round the texts of a table, or lists of them; `kinds`: the steps of further keys. Soaks get no shorter."""
        for key, name in (_KINDS | kinds).items():
            way = ROUND_CEILING if key == "soak" else ROUND_HALF_EVEN
            value = table.get(key)
            if isinstance(value, str):
                table[key] = self.text(name, value, way)
            elif isinstance(value, list):
                table[key] = [self.text(name, text, way) for text in cast("list[str]", value)]

    def on_grid(self, angle: float) -> float:
        """The nearest multiple of the controllers' step, rad; whole turns stay whole."""
        turns = angle / (2.0 * math.pi)
        if abs(turns - round(turns)) <= 1e-9 * max(abs(turns), 1.0):
            return 2.0 * math.pi * round(turns)
        return float(self.to("angle", angle))

    def cycle(self, spec: Spec, schedule: PlanSchedule, cycle: Table) -> None:
        """Every rest and turn of a cycle in full, and the axes' first angles."""
        axes, gyro = spec.rig.table.axis, spec.sensor.gyro
        usable = math.inf if gyro is None else gyro.usable_rate or math.inf
        start = cycle.get("start", {})
        self.entries(start, **dict.fromkeys(start, "angle"))
        moves: list[Table] = []
        lasting: list[float] = []
        before, at = list(schedule.start), [self.on_grid(angle) for angle in schedule.start]
        for step in schedule.steps:
            move, k, of_file = step.move, step.axis, cycle["moves"][step.source]
            kept = {key: of_file[key] for key in ("read_every", "other_axes") if key in of_file}
            self.entries(kept)
            if k < 0:
                lasts = self.to("time", move.duration)
                moves.append({"rest": lasts.text if move.duration else "0 s"} | kept)
            elif move.shape == "hand":
                moves.append(dict(of_file))
                self.entries(moves[-1])
                lasts = units.parse(moves[-1]["duration"], "time") + float(spec.rig.table.answer_time)
                before[k] += move.angle
                at[k] += move.angle
            else:
                before[k] += move.angle
                if move.shape != _SHAPE:
                    shape = f'turns of shape "{move.shape}"'
                    self.notes[f"{shape} are executed as trapezoids of the same angle, peak rate and duration"] = None
                if (angle := self.on_grid(before[k]) - at[k]) == 0.0:
                    # Less than a step of the controller: no turn.
                    lasts = self.to("time", move.duration, ROUND_CEILING)
                    moves.append({"rest": lasts.text})
                else:
                    fastest = min(float(axes[k].max_rate), usable)
                    turned, rate, lasts = self.turn(angle, move, float(axes[k].max_acceleration), fastest)
                    turn = {"turn": turned.text, "peak_rate": rate, "duration": lasts.text, "shape": _SHAPE}
                    moves.append(turn | {"axis": axes[k].name} | kept)
                    at[k] += turned
            lasting.append(lasts)
        cycle["moves"] = moves
        self.entries(cycle.get("other_axes", {}))
        self.keep_period(schedule, cycle, lasting)

    def keep_period(self, schedule: PlanSchedule, cycle: Table, lasting: list[float]) -> None:
        """Shorten the longest standstill by the time that rounding added, so that as many repetitions fit as before, or
        make it longer by the time that it took off the turns. `lasting`: how long each move takes, s."""
        rests = [(lasts, move, "rest") for lasts, move in zip(lasting, cycle["moves"], strict=True) if "rest" in move]
        moving, others = math.fsum(lasting), 0.0
        other, period = cycle.get("other_axes"), schedule.period
        if other is not None:
            others = units.parse(other["duration"], "time")
        over = moving + others - period
        if any(repetitions(s.duration, moving, period)[0] < s.cycles for s in schedule.stretches):
            # The moves themselves no longer fit at the end: the time of the other axes does not help.
            over = max(over, moving - duration_of(schedule.steps))
        elif other is not None:
            rests.append((others, other, "duration"))
        if not rests:
            return
        longest, table, key = max(rests, key=lambda entry: entry[0])
        if abs(over) > 1e-9 * period and longest - over >= 2.0 * float(self.steps.time):
            table[key] = self.to("time", longest - over, ROUND_FLOOR).text

    def turn(self, angle: float, move: ResolvedMove, steepest: float, fastest: float) -> tuple[Quantity, str, Quantity]:
        """A turn by `angle` with a move's peak rate and ramps, on the grids of angle, rate and time, no steeper than
        the table may: its angle, the text of its rate, and its duration."""
        turns = angle / (2.0 * math.pi)
        turned = self.to("angle", angle)
        if abs(turns - round(turns)) <= 1e-9 * abs(turns):
            turned = Quantity.read(f"{360 * round(turns)} deg", "angle")
        elif not turned:
            turned = self.to("angle", math.copysign(float(self.steps.angle), turns))
        rate = self.to("rate", abs(move.peak_rate))
        if rate > fastest * (1.0 + 1e-9):
            rate = self.to("rate", abs(move.peak_rate), ROUND_FLOOR)
        if rate <= 0.0:
            rate = self.steps.rate
        size, peak = abs(float(turned)), float(rate)
        ramp, least = abs(move.peak_rate) / trapezoid_acceleration(move), peak / steepest
        planned = peak / max(ramp, least)
        made = makeable_acceleration(planned, self.steps.acceleration, steepest)
        if abs(made - planned) > _SAME_ACCELERATION * planned:
            ramp = least = peak / made
        lasts = self.to("time", size / peak + max(ramp, least), ROUND_CEILING)
        if peak > 2.0 * size / lasts:
            # Ramps only: the peak follows from angle and duration, one step lower where it is on the grid.
            rate = self.to("rate", 2.0 * size / lasts, ROUND_FLOOR)
            if rate <= size / lasts:
                return turned, units.format_quantity(2.0 * size / lasts, "deg/s"), lasts
        return turned, rate.text, lasts
