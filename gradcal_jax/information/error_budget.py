"""The error budget: the share of every error source in each residual.

An estimate is linear in the readings, `β̂ = Kᵀy`, and what is known beforehand. Its covariance is a sum over sources,
`Kᵀ V_σ K` each, so that with the derivative of a residual s in the covariance (the estimate is the best one: a change
of K counts for nothing) the shares `∂ ln s / ∂ ln σ` follow. With those of the priors they add up to one, since s is
homogeneous in all standard deviations together.
"""

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from jaxtyping import Float

from gradcal_jax.information import NoiseSteps, imu_system, noise_parts, weights
from gradcal_jax.information.figures import CORRELATION_TIME, Figure, noise_figures, with_ratios
from gradcal_jax.information.gears import rows_of_gears
from gradcal_jax.information.plan_information import estimator_of_means
from gradcal_jax.information.posterior import noise_of_sums
from gradcal_jax.information.residual import residual_map, residual_of
from gradcal_jax.information.unseen import CountedPosteriors, widened
from gradcal_jax.model.build import BuiltImu, unweighted_estimator
from gradcal_jax.spec.requirement import MisalignmentRequirement, Requirement

PRIOR: Final = "prior knowledge"
DISCREPANCY: Final = "model discrepancy"
# Sources of the installation's parameters, by the beginning of their names.
_INSTALLATION: Final[Mapping[str, str]] = {
    "angle_": "encoder's error by angle",
    "sample_clock": "sample clock",
    "gravity": "gravity",
    "tilt": "tilt of the base",
    "azimuth": "azimuth of the base",
    "orthogonality": "angles between the table's axes",
    "mounting": "mounting",
}
# Share of the whole below which the rest is rounding, not prior knowledge.
_ROUNDING = 5e-3


class ErrorBudget:
    """The error sources of a plan: by name the part of each in the covariance of noise and priors."""

    def __init__(self, budget: CountedPosteriors) -> None:
        self.budget, self.built, self.known = budget, budget.built, budget.fit
        self.parts: dict[str, Float[np.ndarray, "p p"]] = {}
        built, motion, model, nodes = self.built, self.built.motion, self.built.model, self.built.body_nodes()
        named, common = rows_of_gears(motion, model, nodes, built.gears)
        steps, columns = imu_system(motion, model, nodes, common=common)
        errors, columns = np.split(np.asarray(columns), [len(named)], axis=1)
        own, covariance = model.calibrated, self.known.spread @ self.known.spread.T
        stds = np.concatenate([np.zeros(0), *(np.asarray(term.stds) for term in model.installation)])
        if unweighted_estimator(built.spec):
            estimator = estimator_of_means(motion, model, steps, columns)
            gain = np.pad(estimator.weights @ estimator.back.T, [(0, 0), (0, model.size - own)])
            of_installation = gain.T @ columns[:, own:] * stds
        else:
            gain = _best_gain(steps, errors, columns) @ covariance
            of_installation = covariance[:, own:] / stds
            hidden = model.discrepancy_stds
            if np.any(hidden):
                self._add(DISCREPANCY, covariance[:, hidden > 0.0] / hidden[hidden > 0.0])
        sources = [
            next(source for begin, source in _INSTALLATION.items() if name.startswith(begin))
            for name in model.names()[own:]
        ]
        common_errors = np.concatenate([gain.T @ errors, of_installation], axis=1)
        for name, column in zip([*named, *sources], common_errors.T, strict=True):
            self._add(name, column[:, None])
        figures = _active_sources(built)
        models = {name: with_ratios(model, figures, {of: float(of == name) for of in figures}) for name in figures}
        parts = noise_parts(motion, models, nodes) if models else {}
        for name, part in zip(parts, noise_of_sums(steps, gain, list(parts.values())), strict=True):
            self.parts[name] = self.parts.get(name, 0.0) + part

    def _add(self, name: str, columns: Float[np.ndarray, "p k"]) -> None:
        self.parts[name] = self.parts.get(name, 0.0) + columns @ columns.T

    def of_fit(self, requirement: Requirement) -> dict[str, float] | None:
        """The share of every source in what noise and priors leave of a requirement's statistic; None where the plan
        cannot observe it. The rest after all sources is that of the priors."""
        root, of = self.known.spread, residual_of(self.built, requirement)
        if not np.isfinite(of.map(self.known).statistic()):
            return None
        changes = {name: [e.part(part, root) for e in of.elements] for name, part in self.parts.items()}
        if DISCREPANCY in changes:
            changes[DISCREPANCY] = [a + e.beyond for a, e in zip(changes[DISCREPANCY], of.elements, strict=True)]
        if of.added:
            name = "mounting" if isinstance(requirement, MisalignmentRequirement) else "bias from dT/dt"
            nothing = [np.zeros(len(e.beyond)) for e in of.elements]
            changes[name] = [of.added + before for before in changes.get(name, nothing)]
        variances = of.variances(root)
        shares = {name: of.slope(variances, [2.0 * c for c in change]) for name, change in changes.items()}
        rest = 1.0 - sum(shares.values())
        return shares | ({PRIOR: rest} if abs(rest) > _ROUNDING else {})

    def shares(self, requirement: Requirement, run: str) -> dict[str, float] | None:
        """The share of all errors in the variance of a requirement's statistic in "this run" or "any run", the largest
        first: of noise and priors, and of what no residual shows. They add up to one. None where it is not observable.
        """
        of_fit = self.of_fit(requirement)
        if of_fit is None:
            return None
        columns = self.budget.counted(run)

        def variance(names: Iterable[str]) -> float:
            known = widened(self.known, {name: columns[name] for name in names})
            return residual_map(self.built, known, requirement).statistic() ** 2

        total = variance(columns)
        fit = variance(()) / total if total else 1.0
        shares = {name: share * fit for name, share in of_fit.items()}
        whole = fit
        for name in columns if total else ():
            share = 1.0 - variance(columns.keys() - {name}) / total
            shares[name] = shares.get(name, 0.0) + share
            whole += share
        return {name: share / whole for name, share in sorted(shares.items(), key=lambda item: -item[1])}


def _best_gain(
    steps: NoiseSteps, errors: Float[np.ndarray, "N k"], columns: Float[np.ndarray, "N p"]
) -> Float[np.ndarray, "N p"]:
    """Weights of the readings in least squares, but for the covariance, with these errors of unit variance in all of
    them: `(V + EEᵀ)⁻¹Φ`."""
    weighed = weights(steps, np.concatenate([errors, columns], axis=1))
    of_errors, of_columns = np.split(weighed, [errors.shape[1]], axis=1)
    common = np.eye(errors.shape[1]) + errors.T @ of_errors
    return of_columns - of_errors @ np.linalg.solve(common, errors.T @ of_columns)


def _active_sources(built: BuiltImu) -> dict[str, Figure]:
    """The noise sources that are not zero and act on this plan."""
    line = built.motion.line
    unread = {"reading noise", "standstill offset", "timing error"} if line.rates else {"rate accuracy"}
    if built.model.encoder.held or not np.any(line.moving):
        unread.add("timing error")
    figures = noise_figures(built.model).items()
    return {n: of for n, of in figures if n not in unread and not n.startswith(CORRELATION_TIME)}


def limited_by(shares: Mapping[str, float] | None, axis: str | None = None) -> str | None:
    """The error sources with the largest shares, in words; of the worst `axis`, where there are several."""
    where = None if axis is None else f"axis {axis}"
    if not shares:
        return where
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    words = ", ".join(f"{name} {share:.0%}" for name, share in largest)
    return words if where is None else f"{where}: {words}"
