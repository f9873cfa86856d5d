"""Error terms that a spec does not name, each with its class's typical value.

With a stated `grade` this value counts as if the file named it (see `typical`); without one it counts in verdicts. A
term that the file names, even with zero or an empty list, is not absent. Only terms with an effect on the spec's own
plan are listed.
"""

import math
from collections.abc import Iterator
from typing import Final

from gradcal_jax import units
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.requirement import QUANTITIES
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import HOST_CLOCK
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.typical import (
    TypicalTerm,
    class_row,
    filled,
    is_of_class,
    other_term,
    sensor_grade,
    si_of,
    terms_of,
    unnamed_terms,
)
from gradcal_jax.tables.quantity import Quantity

EARTH_IS_UNKNOWN: Final = (
    "the Earth's rate along the axis is not stated, so the bias includes up to 15.04 deg/h of this rate: give "
    "[rig.site] latitude"
)
# By how much rotation may raise χ² of a gyro that has some thousands of readings.
_NOTICED: Final = 10.0


def absent_lever_arm(spec: Spec) -> TypicalTerm | None:
    """The lever arm of gyros that are sensitive to acceleration, its key in the spec, where the spec leaves it out and
    tests of the fit would notice it."""
    gyro = spec.sensor.gyro
    if gyro is None or gyro.g_sensitivity is None or gyro.g_sensitivity.prior is None:
        return None
    if "lever_arm" in gyro.g_sensitivity.model_fields_set:
        return None
    # Where rotation adds to the specific force that a gyro is sensitive to.
    term = other_term("off_the_axes" if spec.sensor.accelerometer is None else "beside_accelerometers")
    arm = Quantity.of(units.parse(term.value, "length"), "m")
    felt = gyro.g_sensitivity.model_copy(update={"lever_arm": arm}).of_rotation
    more = felt**2 * _fourth_power_of_rates(spec) / float(gyro.angle_random_walk) ** 2
    return term._replace(key=f"sensor.gyro.{term.key}") if more > _NOTICED else None


def _fourth_power_of_rates(spec: Spec) -> float:
    """The integral of the fourth power of the plan's rates over time, (rad/s)⁴s, with the mean rate of each turn."""
    if isinstance(schedule := spec.schedule, StandardSchedule):
        return len(schedule.temperatures) * schedule.integration * sum(rate**4 for rate in schedule.rates)
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    turns = [s.move for s in schedule.steps if not s.move.is_rest and s.move.duration]
    return cycles * sum(abs(move.angle) ** 4 / move.duration**3 for move in turns)


def absent_terms(spec: Spec) -> list[TypicalTerm]:
    """Every term of the error budget that affects the plan, and that neither the file nor its class states."""
    terms = [term for term in _with_effect(spec) if not is_of_class(spec, term.key)]
    for k, term in enumerate(terms):
        # Beside other channels a sensitivity to dT/dt is a figure, and no parameter.
        if not spec.is_one_axis and term.key == "sensor.gyro.bias_temperature_gradient":
            terms[k] = term._replace(value=term.value["prior"])
        # The computer's clock counts, with which a run compares the sensor's, unless the spec takes the sensor's.
        if term.key == "sensor.sample_clock_error" and spec.sensor.clock != "sensor":
            terms[k] = term._replace(value=f"{HOST_CLOCK * 1e6:g} ppm", source="the computer's clock")
    arm = absent_lever_arm(spec)
    return [*terms, *([] if arm is None else [arm]), *_of_branches(spec)]


def class_terms(spec: Spec) -> list[TypicalTerm]:
    """Every term that affects the plan, and that has the figure of the class that the file states."""
    return [term for term in _with_effect(spec) if is_of_class(spec, term.key)]


def with_typical(spec: Spec) -> Spec:
    """The spec with every absent term at its typical value. Errors: `SpecError` where the two contradict each other."""
    terms = absent_terms(spec)
    # The typical scale error of gears is that of their backlash, too.
    ends = ".angle.scale_error"
    none = [TypicalTerm(t.key.replace(ends, ".angle.backlash"), "0 deg", "") for t in terms if t.key.endswith(ends)]
    return filled(spec, [*none, *terms], named=True)


def _with_effect(spec: Spec) -> Iterator[TypicalTerm]:
    """Terms that the file does not name, and that affect its plan."""
    useless = _without_effect(spec)
    return (term for term in unnamed_terms(spec) if term.key.rpartition(".")[2] not in useless)


def _without_effect(spec: Spec) -> set[str]:
    """The last parts of the keys of terms that do not affect the plan."""
    sensor, plan, alone = spec.sensor, spec.plan, spec.is_one_axis
    gyro, force = sensor.gyro, sensor.accelerometer
    scale, bias = (gyro is not None and getattr(gyro, name) is not None for name in ("scale_factor", "bias"))
    by_clock = scale or (force is not None and force.velocity_increments)
    stepped = isinstance(plan, StandardPlan)
    moves = [] if stepped else [step.move for step in spec.gradient_schedule.steps]
    turns = any(plan.rates or ()) if isinstance(plan, StandardPlan) else bool(moves)
    on_the_move = any(move.read_every is not None and not move.is_rest for move in moves)
    geared = bool(spec.rig.table.axis[0].angle.scale_error)
    rules = (
        (not by_clock or sensor.clock == "host", "sample_clock_error"),
        (not scale, "scale_factor_instability scale_error"),
        (not alone, "thermal_lag temperature_error timing_error backlash"),
        (alone and not bias, "bias_temperature_gradient"),
        (alone and stepped, "thermal_lag bias_temperature_gradient temperature_lag reading_noise"),
        # A standing axis is read at one angle: only errors that change between readings have an effect.
        (alone and (stepped or not turns), "standstill_offset harmonics scale_error backlash"),
        (alone and not (scale and turns), "accuracy"),
        # A typical scale error is that of gears with their play, and where there is none, there is no gear.
        (alone and not (scale and geared), "backlash"),
        (alone and not on_the_move, "timing_error"),
        (not (alone and turns), "rate_accuracy"),
    )
    return {key for holds, keys in rules if holds for key in keys.split()}


def _hysteresis_of(quantity: str) -> tuple[str, str]:
    """The kind of a quantity's channels, and the key of its hysteresis terms."""
    of = QUANTITIES[quantity]
    return of.kind, "hysteresis" if of.section == "bias" else f"{of.section}_hysteresis"


def _of_branches(spec: Spec) -> Iterator[TypicalTerm]:
    """Hysteresis of quantities that are required on a branch of the temperature."""
    branched = {_hysteresis_of(r.quantity) for r in spec.requirement if getattr(r, "branch", None) is not None}
    for kind, key in sorted(branched):
        triad = getattr(spec.sensor, kind)
        if triad is not None and key not in triad.model_fields_set:
            yield _play(spec, kind, key)._replace(key=f"sensor.{kind}.{key}")


def _play(spec: Spec, kind: str, key: str) -> TypicalTerm:
    """The hysteresis of the class."""
    of = "sensor" if kind == "gyro" else kind
    return next(term for term in terms_of(of, sensor_grade(spec.sensor, of).name, "path") if term.key == key)


def branch_sentences(spec: Spec) -> list[str]:
    """What requirements leave out that name no branch of the temperature, with the figures of the class."""
    left, widest = list[str](), 0.0
    for quantity in QUANTITIES:
        kind, key = _hysteresis_of(quantity)
        # (Only some quantities may state a branch.)
        open_ones = [r for r in spec.requirement if r.quantity == quantity and getattr(r, "branch", "") is None]
        triad = getattr(spec.sensor, kind)
        if not open_ones or triad is None or key in triad.model_fields_set:
            continue
        play = _play(spec, kind, key).value[0]
        width = si_of(play["width"])
        size, per = play["prior"].split(" ")
        left.append(f"±{float(size) * width:.3g} {per.removesuffix('/K')} of the {quantity.replace('_', ' ')}")
        widest = max(widest, width)
    if not left:
        return []
    sentences = [
        f"the requirements do not distinguish heating and cooling, so a hysteresis (in this class {', '.join(left)}) "
        'is not counted: add branch = "both" (or "heating" or "cooling") to them'
    ]
    if _goes_one_way(spec):
        returns = f"change the temperature back by {2.0 * widest:g} K or more{minutes_of_change(spec, 2.0 * widest)}"
        sentences.append(
            "one-way ramp, so the plan cannot observe a hysteresis, nor tell a drift during the run from a dependence "
            f"on temperature: {returns}"
        )
    return sentences


def attitude_sentences(spec: Spec) -> list[str]:
    """What requirements on the bias of gyros leave out where the spec has no sensitivity to acceleration."""
    gyro = spec.sensor.gyro
    names = [r.name for r in spec.requirement if r.quantity == "gyro_bias"]
    if gyro is None or gyro.g_sensitivity is not None or not names:
        return []
    size = class_row("sensor", sensor_grade(spec.sensor).name)["g_sensitivity"]["value"].removesuffix("/g")
    words = ", ".join(f"'{name}'" for name in names)
    return [
        f"{words}: the result holds for the attitudes of the calibration. In another attitude, g-sensitivity "
        f"changes the bias of a gyro of this class by ±{size} for each g; this error is not counted: add "
        "[sensor.gyro.g_sensitivity] to estimate it"
    ]


def _goes_one_way(spec: Spec) -> bool:
    """Whether the plan's temperature changes in one direction alone."""
    if isinstance(spec.plan, StandardPlan):
        return False
    ramps = [s.temperature_end - s.temperature_start for s in spec.gradient_schedule.segments if s.kind == "ramp"]
    return len({change > 0.0 for change in ramps}) == 1


def minutes_of_change(spec: Spec, change_k: float) -> str:
    """The time that the chamber needs for a change of temperature at the slower of its rates, in brackets."""
    rate = min(float(spec.rig.chamber.max_heating), float(spec.rig.chamber.max_cooling))
    return f" ({change_k / rate / 60.0:.3g} min at {rate * 60.0:.3g} K/min)" if math.isfinite(rate) and rate else ""
