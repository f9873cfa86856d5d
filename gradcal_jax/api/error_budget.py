"""The error budget of a plan: the share of every error source in each residual."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import equinox as eqx
import numpy as np

from gradcal_jax.api.build import Assembled
from gradcal_jax.api.posterior_of_plan import contrasts_of, residual_map, unweighted_estimator, weights
from gradcal_jax.arrays import namespace
from gradcal_jax.files.moves import Axis
from gradcal_jax.information import Posterior, at_readings, least_squares, noise_steps, statistic
from gradcal_jax.information.budget import Sensitivity, noise_shares, unweighted_shares
from gradcal_jax.information.by_reading import filter_readings
from gradcal_jax.model import Discrepancy, SensorModel

PRIOR: Final = "prior knowledge"
ENCODER: Final = "angle error of the encoder"
DISCREPANCY: Final = "model discrepancy"

Field = Callable[[SensorModel], Any]
FIGURES: Final[dict[str, Field]] = {
    "angle random walk": lambda m: m.angle_random_walk,
    "rate accuracy": lambda m: m.reference.rate_accuracy,
    "reading noise": lambda m: m.reference.reading_noise,
    "standstill offset": lambda m: m.reference.standstill_offset,
    "timing error": lambda m: m.reference.timing_error,
}
"""Accessors of the noise figures that every model has, by error source."""


def error_budget(built: Assembled, channel: Axis, known: Posterior) -> dict[str, dict[str, float]]:
    """For each requirement, the share of each error source in its statistic: `∂ ln s / ∂ ln σ`.

    The residual is homogeneous of degree one in all standard deviations together, so the shares add up to one; the
    rest after all sources is the share of the priors. Requirements that the plan cannot observe are left out.
    """
    model, line = built.model, built.trajectory(channel)
    by_rates = unweighted_estimator(built.spec)
    steps, columns = noise_steps(line, model), at_readings(line, model)
    start = np.zeros((len(steps.initial), columns.shape[1]))
    readings = None if by_rates else filter_readings(start, steps.initial, steps, columns)
    parts = {name: noise_steps(line, only(built, name)) for name in active_sources(built)}
    shares: dict[str, dict[str, float]] = {}
    for requirement in built.spec.requirement:
        values = residual_map(built, known, requirement, si=True)[2] * weights(requirement, requirement.statistic)
        total = statistic(requirement.statistic, values)
        if not np.isfinite(total) or total <= 0.0:
            continue
        places = contrasts_of(model, requirement, requirement.statistic)
        slope = Sensitivity(known, places, requirement.statistic, values)
        if readings is None:
            budget = unweighted_shares(least_squares(line, model), slope.of_covariance, parts)
        else:
            budget = noise_shares(steps, readings, slope.of_gram, parts)
            budget |= _of_priors(model, slope)
        budget = {name: value / total for name, value in budget.items()}
        rest = 1.0 - sum(budget.values())
        if abs(rest) > 5e-3:
            budget[PRIOR] = rest
        shares[requirement.name] = dict(sorted(budget.items(), key=lambda item: -item[1]))
    return shares


def _of_priors(model: SensorModel, slope: Sensitivity) -> dict[str, float]:
    """The same derivative for errors of the rig and of the structure that are parameters with a prior."""
    budget: dict[str, float] = {}
    for term in model.terms:
        name = ENCODER if term is model.harmonics else DISCREPANCY if isinstance(term, Discrepancy) else None
        if name is not None:
            rows, where = term.prior_rows(), model.where(term.name)
            budget[name] = budget.get(name, 0.0) - 2.0 * float(np.sum(slope.of_gram[where, where] * (rows.T @ rows)))
    if DISCREPANCY in budget:
        budget[DISCREPANCY] += 2.0 * slope.of_beyond
    return budget


def active_sources(built: Assembled) -> list[str]:
    """Names of the error sources that are not zero and act on this plan."""
    moves = len(built.trajectory().moving_pieces)
    return [name for name in known_sources(built) if name != "timing error" or moves]


def known_sources(built: Assembled) -> list[str]:
    """Names of the error sources that are not zero and act on this kind of reading."""
    rates = built.trajectory().rates
    unread = ("reading noise", "standstill offset", "timing error") if rates else ("rate accuracy",)
    figures = [n for n, of in FIGURES.items() if n not in unread and float(np.asarray(of(built.model))) > 0.0]
    return figures + list(built.sources)


def only(built: Assembled, name: str) -> SensorModel:
    """The model with one error source alone."""
    return scaled(built, {n: float(n == name) for n in active_sources(built)})


def scaled(built, factors: Mapping[str, Any]) -> SensorModel:
    """The model of `built` with its error sources multiplied by factors."""
    model = built.model
    sizes: list = [1.0] * model.processes.count
    for name, members in built.sources.items():
        for k in members:
            sizes[k] = factors.get(name, 1.0)
    if sizes:
        xp = namespace(sizes)
        size = xp.stack([xp.asarray(s) for s in sizes])
        processes = model.processes
        model = eqx.tree_at(
            lambda m: (m.processes.initial_std, m.processes.diffusion),
            model,
            (processes.initial_std * size, processes.diffusion * size),
        )
    for name, of in FIGURES.items():
        if name in factors:
            larger = of(model) * factors[name]
            model = eqx.tree_at(of, model, namespace(larger).asarray(larger))
    return model


def limited_by(shares: dict[str, float] | None) -> str | None:
    """The error sources with the largest shares, in words."""
    if not shares:
        return None
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    return ", ".join(f"{name} {share:.0%}" for name, share in largest)
