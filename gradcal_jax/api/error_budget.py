"""The error budget of a plan: the share of every error source in each residual."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.api.imu_build import BuiltImu, unweighted_estimator
from gradcal_jax.api.imu_residual import RequiredQuantity, quantity_of
from gradcal_jax.api.verdicts import mission_weights
from gradcal_jax.files.requirement import MisalignmentRequirement, Requirement
from gradcal_jax.information import Posterior, estimator_of_means, imu_system, noise_parts, statistic
from gradcal_jax.information.budget import Sensitivity, information_lost, sensitivity_of, weights_of
from gradcal_jax.information.posterior import noise_of_sums
from gradcal_jax.information.residual import Contrasts
from gradcal_jax.model import ChannelKind, Discrepancy, ImuModel

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
        self._sources |= information_lost(steps, np.asarray(columns), parts)
        for k, name in enumerate(names[own:], own):
            of_prior = np.zeros((model.size, model.size))
            of_prior[k, k] = stds[k - own] ** -2.0
            self._add(_source_of(name), of_prior)
        for c in model.channels:
            for term in c.model.terms:
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
        total, slope, beside = _slope_of(quantity, self.known)
        if not np.isfinite(total) or total <= 0.0:
            return None
        of = slope.of_covariance if self._unweighted else -slope.of_gram
        budget = {name: 2.0 * float(np.sum(of * part)) for name, part in self._sources.items()}
        if DISCREPANCY in budget:
            budget[DISCREPANCY] += 2.0 * slope.of_beyond
        if beside:
            name = "mounting" if isinstance(requirement, MisalignmentRequirement) else "bias from dT/dt"
            budget[name] = budget.get(name, 0.0) + 2.0 * beside
        budget = {name: value / total for name, value in budget.items()}
        rest = 1.0 - sum(budget.values())
        if abs(rest) > _ROUNDING:
            budget[PRIOR] = rest
        return dict(sorted(budget.items(), key=lambda item: -item[1]))


def _slope_of(quantity: RequiredQuantity, known: Posterior) -> tuple[float, Sensitivity, float]:
    """The statistic of a quantity (SI), its derivatives, and the part of what stands beside, half its derivative in
    the logarithm of that."""
    requirement, size = quantity.requirement, len(known.spread)
    found = quantity.residual(known)
    weight = mission_weights(requirement, requirement.statistic)
    values = found.values / found.si * weight
    each = np.array([statistic(requirement.statistic, of) for of in values])
    total = float(np.sqrt(np.mean(each**2)) if requirement.axis == "all" else np.max(each))
    nothing = Sensitivity(np.zeros((size, size)), np.zeros((size, size)), 0.0)
    if not np.isfinite(total) or total <= 0.0:
        return total, nothing, 0.0
    outer = each / (total * len(each)) if requirement.axis == "all" else np.arange(len(each)) == np.argmax(each)
    slope, beside = nothing, 0.0
    for element, own, of in zip(quantity.elements, outer, values, strict=True):
        of_value = (own * weights_of(requirement.statistic, of)).ravel()
        counts = of_value > 0.0
        if not np.any(counts):
            continue
        # d value = weight² · d variance / (2 value)
        of_variance = 0.5 * (np.broadcast_to(weight, of.shape).ravel() ** 2 * of_value)[counts] / of.ravel()[counts]
        part = Posterior(known.spread[element.where], known.hidden[element.where])
        states = element.states()
        worst = np.argmax([state.left(part) for state in states], axis=0) if len(states) > 1 else np.zeros(of.size, int)
        for k in np.unique(worst[counts]):
            here = counts & (worst == k)
            rows, alone, beyond = (np.asarray(x)[here] for x in states[k])
            places = Contrasts(_widened(rows, element.where, size), _widened(alone, element.where, size), beyond)
            more = sensitivity_of(known, places, of_variance[here[counts]])
            slope = slope.plus(more)
        beside += float(np.sum(of_variance)) * quantity.beside**2
    return total, slope, beside


def _widened(rows: np.ndarray, where: slice, size: int) -> np.ndarray:
    """Rows of some parameters as rows of all."""
    wide = np.zeros((len(rows), size))
    wide[:, where] = rows
    return wide


def _source_of(parameter: str) -> str:
    """The error source of an installation's parameter."""
    return next(source for begin, source in _INSTALLATION.items() if parameter.startswith(begin))


def source_name(kind: ChannelKind, process: str) -> str:
    """The name of a process of one kind of channel as an error source."""
    return process if kind == "gyro" else f"accelerometer {process}"


def _active_sources(built: BuiltImu) -> list[str]:
    """Names of the noise sources that are not zero and act on this plan."""
    model, line = built.model, built.motion.line
    white = {c.kind for c in model.channels if _is_there(c.model.angle_random_walk)}
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
        processes = c.model.processes
        sizes = np.zeros(processes.count)
        for name, members in built.sources[c.kind].items():
            sizes[list(members)] = float(source_name(c.kind, name) == source)
        parts = (
            c.model.angle_random_walk * float(_WHITE[c.kind] == source),
            processes.initial_std * sizes,
            processes.diffusion * sizes,
        )
        of = lambda m, k=k: (  # noqa: E731
            m.channels[k].model.angle_random_walk,
            m.channels[k].model.processes.initial_std,
            m.channels[k].model.processes.diffusion,
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
