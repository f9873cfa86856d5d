"""Warnings of a prediction."""

from typing import cast

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.posterior_of_plan import DEG_PER_H, DEG_PER_S, posterior_of_plan, survey
from gradcal_jax.files import Spec
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.formulas import RAMPED_SHAPES
from gradcal_jax.information import Posterior, unobservable_combinations

# Relative difference of rates that rounding to a controller's steps explains.
_NEARLY = 1e-3


def unobservable(spec: Spec) -> list[str]:
    """One sentence for each combination of parameters (named as in the paper, SI) that the plan cannot observe.

    Errors: none.
    """
    built = assemble(spec)
    return [s for channel in built.channels for s in _unobservable(built, channel, posterior_of_plan(built, channel))]


def _unobservable(built: Assembled, channel: str, known: Posterior) -> list[str]:
    where = f" on axis {channel}" if len(built.channels) > 1 else ""
    combinations = unobservable_combinations(known, built.model)
    if not combinations:
        return []
    cures = "; ".join(_cures(built, channel)) or "change the plan"
    return [
        f"the plan cannot observe {combination}{where}: {cures}; or give it a prior" for combination in combinations
    ]


def _cures(built: Assembled, channel: str) -> list[str]:
    """What the plan has too few of: rates or temperatures, compared with the number of coefficients."""
    sensor, seen = built.spec.sensor, built.trajectory(cast("Axis", channel))
    surveyed = survey(built, cast("Axis", channel))
    cures: list[str] = []
    if sensor.scale_factor is not None:
        needed, rates = sensor.scale_factor.rate.size, distinct_rates(built.spec)
        if surveyed.fastest == 0.0:
            cures.append("the axis never turns: add turns")
        elif rates is not None and rates < needed:
            cures.append(
                f"{_number(rates)} distinct {'rate' if rates == 1 else 'rates'} for {_number(needed)} coefficients in "
                f"rate: add a turn at {'a second' if rates == 1 else 'another'} rate"
            )
    if surveyed.warmest - surveyed.coldest < 1.0 and len(seen.ends()[0]):
        sizes = [part.temperature.size for part in (sensor.bias, sensor.scale_factor) if part is not None]
        if max(sizes) > 1:
            cures.append(f"one temperature for {_number(max(sizes))} coefficients in temperature: go through a range")
    elif isinstance(built.spec.plan, StandardPlan):
        sizes = [part.temperature.size for part in (sensor.bias, sensor.scale_factor) if part is not None]
        visited = len(set(built.spec.schedule.temperatures)) if isinstance(built.spec.schedule, StandardSchedule) else 0
        if visited < max(sizes):
            cures.append(
                f"{_number(visited)} temperatures for {_number(max(sizes))} coefficients in temperature: add "
                f"{_number(max(sizes) - visited)}"
            )
    return cures


def _number(count: int) -> str:
    words = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    return words[count] if count < len(words) else str(count)


def distinct_rates(spec: Spec) -> int | None:
    """The number of different rates, counted with sign, at which the plan turns; None where a move's rate varies
    throughout."""
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        return len({round(rate * DEG_PER_S, 6) for rate in schedule.rates})
    turns = [m for m in (schedule.cycle.moves if schedule.cycle else ()) if not m.is_rest]
    if not all(m.shape in RAMPED_SHAPES for m in turns):
        return None
    return len({round(m.peak_rate * DEG_PER_S, 6) for m in turns})


def warnings(built: Assembled, known: dict[Axis, Posterior]) -> list[str]:
    spec, sensor = built.spec, built.spec.sensor
    sentences = [s for channel in built.channels for s in _unobservable(built, channel, known[channel])]
    surveys = [survey(built, channel) for channel in built.channels]
    coldest, warmest = min(s.coldest for s in surveys), max(s.warmest for s in surveys)
    fastest = max(s.fastest for s in surveys)
    for requirement in spec.requirement:
        low, high = (float(t) for t in requirement.temperature)
        if low < coldest - 1e-6 or high > warmest + 1e-6:
            sentences.append(
                f"requirement '{requirement.name}' asks for {low:g} … {high:g} °C, but the sensor goes through "
                f"{coldest:.4g} … {warmest:.4g} °C only: beyond that the structure of the maps is trusted"
            )
        if requirement.quantity == "scale_factor" or requirement.quantity == "heading":
            widest = max(abs(float(r)) for r in requirement.rate)
            if widest > fastest * (1.0 + _NEARLY):
                required, reached = widest * DEG_PER_S, fastest * DEG_PER_S
                sentences.append(
                    f"requirement '{requirement.name}' asks for rates up to {required:.4g} deg/s, but the plan reaches "
                    f"{reached:.4g} deg/s only: beyond that the structure of the map is trusted"
                )
    if sensor.turn_on_bias and sensor.bias is not None:
        sentences.append(
            "within one run the turn-on bias cannot be told from a0: the bias map is this run's, and another "
            f"run's differs by {float(sensor.turn_on_bias) * DEG_PER_H:.4g} deg/h (standard deviation)"
        )
    return sentences
