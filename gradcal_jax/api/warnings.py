"""What a prediction should not be read without."""

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.posterior_of_plan import DEG_PER_H, DEG_PER_S, posterior_of_plan, survey
from gradcal_jax.files import Spec
from gradcal_jax.files.moves import Axis
from gradcal_jax.information import Posterior, unobservable_combinations

# Of a rate: what rounding to a controller's steps takes off is not worth a word.
_NEARLY = 1e-3


def unobservable(spec: Spec) -> list[str]:
    """One sentence for each combination of parameters (named as in the paper, SI) that the plan cannot observe.

    Errors: none.
    """
    built = assemble(spec)
    return [s for channel in built.channels for s in _unobservable(built, channel, posterior_of_plan(built, channel))]


def _unobservable(built: Assembled, channel: str, known: Posterior) -> list[str]:
    where = f" on axis {channel}" if len(built.channels) > 1 else ""
    return [
        f"the plan cannot observe {combination}{where}: give it a prior, or change the plan"
        for combination in unobservable_combinations(known, built.model)
    ]


def warnings(built: Assembled, known: dict[Axis, Posterior]) -> list[str]:
    spec, sensor = built.spec, built.spec.sensor
    found = [s for channel in built.channels for s in _unobservable(built, channel, known[channel])]
    surveys = [survey(built, channel) for channel in built.channels]
    coldest, warmest = min(s.coldest for s in surveys), max(s.warmest for s in surveys)
    fastest = max(s.fastest for s in surveys)
    for requirement in spec.requirement:
        low, high = (float(t) for t in requirement.temperature)
        if low < coldest - 1e-6 or high > warmest + 1e-6:
            found.append(
                f"requirement '{requirement.name}' asks for {low:g} … {high:g} °C, but the sensor goes through "
                f"{coldest:.4g} … {warmest:.4g} °C only: beyond that the structure of the maps is trusted"
            )
        if requirement.quantity == "scale_factor":
            widest = max(abs(float(r)) for r in requirement.rate)
            if widest > fastest * (1.0 + _NEARLY):
                asked, reached = widest * DEG_PER_S, fastest * DEG_PER_S
                found.append(
                    f"requirement '{requirement.name}' asks for rates up to {asked:.4g} deg/s, but the plan reaches "
                    f"{reached:.4g} deg/s only: beyond that the structure of the map is trusted"
                )
    if sensor.turn_on_bias and sensor.bias is not None:
        found.append(
            "within one run the turn-on bias cannot be told from a0: the bias map is this run's, and another "
            f"run's differs by {float(sensor.turn_on_bias) * DEG_PER_H:.4g} deg/h (standard deviation)"
        )
    return found
