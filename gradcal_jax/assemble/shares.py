"""What a plan is limited by: the share of every error source in a residual."""

import equinox as eqx
import numpy as np

from gradcal_jax import plans
from gradcal_jax.assemble.build import Assembled
from gradcal_jax.assemble.knowledge import knowledge, residual_map
from gradcal_jax.errormodel import GyroModel
from gradcal_jax.information import Posterior, statistic

_STEP = 0.01


def error_shares(built: Assembled, channel: str = "x") -> dict[str, dict[str, float]]:
    """For each requirement, the share of each error source in its statistic: `∂ ln s / ∂ ln σ`, by differences.

    The residual is homogeneous of degree one in all standard deviations together, so the shares add up to one; what the
    sources of noise leave is the priors' ("prior knowledge").
    """
    scaled = {
        name: (_with_source(built, name, 1.0 - _STEP), _with_source(built, name, 1.0 + _STEP))
        for name in active_sources(built)
    }
    values = {
        name: [_statistics(built, knowledge(built, channel, model)) for model in pair] for name, pair in scaled.items()
    }
    shares: dict[str, dict[str, float]] = {}
    for requirement in built.spec.requirement:
        key = requirement.name
        found = {}
        for name, (low, high) in values.items():
            if np.isfinite(low[key]) and np.isfinite(high[key]) and low[key] > 0.0:
                found[name] = float(np.log(high[key] / low[key]) / np.log((1.0 + _STEP) / (1.0 - _STEP)))
        if found:
            rest = 1.0 - sum(found.values())
            if abs(rest) > 5e-3:
                found["prior knowledge"] = rest
            shares[key] = dict(sorted(found.items(), key=lambda item: -item[1]))
    return shares


def active_sources(built: Assembled) -> list[str]:
    """Names of the error sources that are not zero."""
    model, reference = built.model, built.model.reference
    names = {"angle random walk": float(model.angle_random_walk)}
    if isinstance(built.plan, plans.StandardPlan):
        names["rate reference"] = float(reference.rate_accuracy)
    else:
        names |= {
            "reading noise": float(reference.reading_noise),
            "standstill offset": float(reference.standstill_offset),
            "timing": float(reference.timing_error) if any(True for _ in built.plan.moves) else 0.0,
            "angle error of the encoder": float(np.sum(np.asarray(reference.harmonic_amplitudes))),
        }
    return [name for name, value in names.items() if value > 0.0] + list(built.sources)


def _with_source(built: Assembled, name: str, factor: float) -> GyroModel:
    """The model with one error source scaled."""
    model = built.model
    if name in built.sources:
        factors = np.ones(model.processes.count)
        factors[list(built.sources[name])] = factor
        return eqx.tree_at(
            lambda m: (m.processes.initial_std, m.processes.diffusion),
            model,
            (model.processes.initial_std * factors, model.processes.diffusion * factors),
        )
    field = {
        "angle random walk": lambda m: m.angle_random_walk,
        "rate reference": lambda m: m.reference.rate_accuracy,
        "reading noise": lambda m: m.reference.reading_noise,
        "standstill offset": lambda m: m.reference.standstill_offset,
        "timing": lambda m: m.reference.timing_error,
        "angle error of the encoder": lambda m: m.reference.harmonic_amplitudes,
    }[name]
    return eqx.tree_at(field, model, np.asarray(field(model) * factor))


def _statistics(built: Assembled, known: Posterior) -> dict[str, float]:
    """The decisive statistic of each requirement."""
    return {r.name: statistic(r.statistic, residual_map(built, known, r)[2]) for r in built.spec.requirement}


def limited_by(shares: dict[str, float] | None) -> str | None:
    if not shares:
        return None
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    return ", ".join(f"{name} {share:.0%}" for name, share in largest)
