"""The error budget: the share of every error source in each residual.

A statistic r of the residual depends on the noise through `G = ΦᵀV⁻¹Φ` alone, and V is a sum over sources, each
proportional to its variance σ². Since `∂G/∂ln σ = −2 ΦᵀV⁻¹V_σV⁻¹Φ` and `dC = −C dG C`, one matrix for each source gives
`∂ln r/∂ln σ` of every residual, with `∂r/∂C` of that residual. With those of the priors these shares add up to one,
since r is homogeneous in all standard deviations together. No finite differences are used.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.information import Posterior, estimator_of_means, imu_system, noise_parts
from gradcal_jax.information.by_reading import adjoint_parts, filter_readings
from gradcal_jax.information.gears import apart_from_gears
from gradcal_jax.information.imu_residual import quantity_of
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.posterior import noise_of_sums
from gradcal_jax.information.unseen import TURN_ON, CountedPosteriors, widened
from gradcal_jax.model import ChannelKind, Discrepancy, ImuModel
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
_WHITE: Final[Mapping[ChannelKind, str]] = {"gyro": "angle random walk", "accelerometer": "velocity random walk"}
_ENCODER: Final[Mapping[str, Callable[[ImuModel], Any]]] = {
    "rate accuracy": lambda m: m.encoder.rate,
    "reading noise": lambda m: m.encoder.reading,
    "standstill offset": lambda m: m.encoder.offset,
    "timing error": lambda m: m.encoder.timing,
}
# Share of the whole below which the rest is rounding, not prior knowledge.
_ROUNDING = 5e-3


class ErrorBudget:
    """The error sources of a plan; `shares` of a requirement are `∂ ln s / ∂ ln σ` of its statistic s."""

    def __init__(self, built: BuiltImu, known: Posterior) -> None:
        self.built, self.known = built, known
        motion, model, nodes = built.motion, built.model, built.body_nodes()
        steps, columns = imu_system(motion, model, nodes)
        models = {name: _only(built, name) for name in _active_sources(built)}
        parts = noise_parts(motion, models, nodes, steps) if models else {}
        own, names = model.calibrated, model.names()
        self._unweighted = unweighted_estimator(built.spec)
        self._sources: dict[str, Float[np.ndarray, "p p"]] = {}
        stds = np.concatenate([np.zeros(0), *(np.asarray(term.stds) for term in model.installation)])
        if self._unweighted:
            estimator = estimator_of_means(motion, model, steps, columns)
            back = np.pad(estimator.back, [(0, model.size - own), (0, 0)])
            for name, part in parts.items():
                self._sources[name] = back @ noise_of_sums(part, estimator.weights) @ back.T
            shared = back @ (estimator.weights.T @ columns[:, own:]) * stds
            for k, name in enumerate(names[own:]):
                self._add(_source_of(name), np.outer(shared[:, k], shared[:, k]))
            return
        if built.gears:
            columns, of_gears = apart_from_gears(motion, model, nodes, built.gears)
            for name, row in of_gears:
                self._add(name, np.outer(row, row))
        self._sources |= _information_lost(steps, np.asarray(columns), parts)
        for k, name in enumerate(names[own:], own):
            of_prior = np.zeros((model.size, model.size))
            of_prior[k, k] = stds[k - own] ** -2.0
            self._add(_source_of(name), of_prior)
        for c in model.channels:
            for term in c.terms:
                if isinstance(term, Discrepancy):
                    of_prior, rows = np.zeros((model.size, model.size)), np.asarray(term.prior_rows())
                    where = model.where(c.kind, c.axis, term.name)
                    of_prior[where, where] = rows.T @ rows
                    self._add(DISCREPANCY, of_prior)

    def _add(self, name: str, part: Float[np.ndarray, "p p"]) -> None:
        self._sources[name] = self._sources.get(name, 0.0) + part

    def shares(self, requirement: Requirement) -> dict[str, float] | None:
        """The share of every source in a requirement's statistic, the largest first; None where the plan cannot observe
        it. The residual is homogeneous of degree one in all standard deviations together, so the shares add up to one;
        the rest after all sources is that of the priors."""
        quantity = quantity_of(self.built, requirement)
        if not quantity.residual(self.known).statistic():
            return None
        root = self.known.spread
        total, of_covariance, of_added = quantity.statistic(requirement.statistic, {}).slope(root)
        of = of_covariance if self._unweighted else root @ (root.T @ of_covariance @ root) @ root.T
        budget = {name: 2.0 * float(np.sum(of * part)) for name, part in self._sources.items()}
        if DISCREPANCY in budget:
            beyond = zip(of_added, quantity.elements, strict=True)
            budget[DISCREPANCY] += 2.0 * sum(float(slope @ e.of.beyond) for slope, e in beyond)
        if quantity.beside:
            name = "mounting" if isinstance(requirement, MisalignmentRequirement) else "bias from dT/dt"
            beside = quantity.beside**2 * sum(float(np.sum(slope)) for slope in of_added)
            budget[name] = budget.get(name, 0.0) + 2.0 * beside
        budget = {name: value / total for name, value in budget.items()}
        rest = 1.0 - sum(budget.values())
        if abs(rest) > _ROUNDING:
            budget[PRIOR] = rest
        return dict(sorted(budget.items(), key=lambda item: -item[1]))


def _source_of(parameter: str) -> str:
    """The error source of an installation's parameter."""
    return next(source for begin, source in _INSTALLATION.items() if parameter.startswith(begin))


def source_name(kind: ChannelKind, process: str) -> str:
    """The name of a process of one kind of channel as an error source."""
    return process if kind == "gyro" else f"accelerometer {process}"


def _active_sources(built: BuiltImu) -> list[str]:
    """Names of the noise sources that are not zero and act on this plan."""
    model, line = built.model, built.motion.line
    white = {c.kind for c in model.channels if _is_there(c.angle_random_walk)}
    names = [name for kind, name in _WHITE.items() if kind in white]
    unread = {"reading noise", "standstill offset", "timing error"} if line.rates else {"rate accuracy"}
    if model.encoder.held or not len(line.moving_pieces):
        unread.add("timing error")
    names += [name for name, of in _ENCODER.items() if name not in unread and _is_there(of(model))]
    return names + [source_name(kind, name) for kind, of in built.sources.items() for name in of]


def _is_there(figure: Any) -> bool:
    return bool(np.any(np.asarray(figure) > 0.0))


def _only(built: BuiltImu, source: str) -> ImuModel:
    """The model with one noise source alone."""
    model = built.model
    for k, c in enumerate(model.channels):
        processes = c.processes
        sizes = np.zeros(processes.count)
        for name, members in built.sources[c.kind].items():
            sizes[list(members)] = float(source_name(c.kind, name) == source)
        parts = (
            c.angle_random_walk * float(_WHITE[c.kind] == source),
            processes.initial_std * sizes,
            processes.diffusion * sizes,
        )
        of = lambda m, k=k: (  # noqa: E731
            m.channels[k].angle_random_walk,
            m.channels[k].processes.initial_std,
            m.channels[k].processes.diffusion,
        )
        model = eqx.tree_at(of, model, parts)
    for name, field in _ENCODER.items():
        model = eqx.tree_at(field, model, np.asarray(field(model)) * float(name == source))
    return model


def limited_by(shares: Mapping[str, float] | None, axis: str | None = None) -> str | None:
    """The error sources with the largest shares, in words; of the worst `axis`, where there are several."""
    where = None if axis is None else f"axis {axis}"
    if not shares:
        return where
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    words = ", ".join(f"{name} {share:.0%}" for name, share in largest)
    return words if where is None else f"{where}: {words}"


def _information_lost(
    steps: NoiseSteps, columns: Float[np.ndarray, "N p"], sources: Mapping[str, NoiseSteps]
) -> dict[str, Float[np.ndarray, "p p"]]:
    """`ΦᵀV⁻¹V_σV⁻¹Φ` of each of `sources`, given by its part of the noise."""
    start = np.zeros((steps.observation.shape[1], columns.shape[1]))
    readings = filter_readings(start, steps.initial, steps, columns)
    lost = {name: np.zeros((columns.shape[1],) * 2) for name in sources}
    for at, us, rhos in adjoint_parts(steps, readings):
        for name, part in sources.items():
            # A source acts on few of the states.
            driven = np.flatnonzero(np.any(part.covariance[at], axis=(0, 1)))
            if len(driven):
                own = np.ascontiguousarray(rhos[:, driven])
                flat, covariance = own.reshape(-1, own.shape[-1]), part.covariance[at][:, driven[:, None], driven]
                lost[name] += flat.T @ (covariance @ own).reshape(flat.shape)
            if np.any(variance := part.reading_variance[at]):
                lost[name] += (us.T * variance) @ us
            if at.start == 0:
                first = steps.transition[0].T @ rhos[0]
                lost[name] += first.T @ part.initial @ first
    return lost


def shares_of_variance(
    budget: CountedPosteriors, run: str, statistic_of: Callable[[Posterior], float]
) -> tuple[float, dict[str, float]]:
    """The share of noise and priors in the variance of a statistic, and those of what no residual shows, by name; they
    add up to one."""
    columns = {n: c for n, c in budget.columns.items() if run == "any run" or n != TURN_ON}
    total = statistic_of(widened(budget.fit, columns)) ** 2
    if not (np.isfinite(total) and total > 0.0):
        return 1.0, {}
    without = {n: statistic_of(widened(budget.fit, {m: c for m, c in columns.items() if m != n})) for n in columns}
    parts = {name: 1.0 - value**2 / total for name, value in without.items()}
    of_fit = statistic_of(budget.fit) ** 2 / total
    whole = of_fit + sum(parts.values())
    return of_fit / whole, {name: part / whole for name, part in parts.items()}
