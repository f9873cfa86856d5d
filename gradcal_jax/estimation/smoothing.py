"""Calibration without a structure: strength of the smoothness prior by marginal likelihood.

A map of bins or B-splines has a prior on the differences of neighbouring coefficients, `D β ~ N(0, s²)`. Too large
an s fits the noise, too small an s smooths the map away. The likelihood of the data with β integrated out,

    −2 ln p(z | s) = min_β (|z − A β|² + |P_s β|²) + ln det(AᵀA + P_sᵀP_s) − ln pdet(P_sᵀP_s) + const,

P_s the rows of all priors, balances both (empirical Bayes; with directions without a prior it is the restricted
likelihood). Each value costs one small factorisation, since the data are first reduced to p rows.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from scipy import optimize

from gradcal_jax.estimation.solve import Whitened
from gradcal_jax.model import ImuModel, Map

_GRID = 13
_DECADES = 3.0


class Smoothness(NamedTuple):
    """Chosen standard deviations of neighbours' differences, by channel and name of the map, in the map's SI unit.

    `at_edge`: whether one of them is at the edge of the searched range, so that the data do not determine it.
    """

    stds: dict[tuple[str, str], float]
    at_edge: bool


def smooth_maps(model: ImuModel) -> list[tuple[int, int]]:
    """The maps with a smoothness prior, as numbers of their channel and of their term."""
    return [
        (i, k)
        for i, channel in enumerate(model.channels)
        for k, term in enumerate(channel.model.terms)
        if isinstance(term, Map) and term.has_smoothness
    ]


def with_smoothness(model: ImuModel, stds: Sequence[float]) -> ImuModel:
    """The model with other standard deviations of its smoothness priors, in the order of `smooth_maps`."""
    places = smooth_maps(model)
    return eqx.tree_at(
        lambda m: [m.channels[i].model.terms[k].smoothness_std for i, k in places],
        model,
        [np.asarray(std, dtype=float) for std in stds],
    )


def choose_smoothness(white: Whitened, model: ImuModel) -> Smoothness:
    """The strengths at which the data are most probable.

    Searched within three decades about the strengths of the model. Errors: `ValueError` for a model without a
    smoothness prior.
    """
    places = smooth_maps(model)
    terms: list[Any] = [model.channels[i].model.terms[k] for i, k in places]
    if not places:
        raise ValueError("no map of this model has a smoothness prior: use B-splines or bins with the key smoothness")
    orthogonal, triangle = np.linalg.qr(white.rows)
    data = orthogonal.T @ white.data
    start = np.log([float(term.smoothness_std) for term in terms])

    def minus_twice(log_std: np.ndarray) -> float:
        prior = np.asarray(with_smoothness(model, np.exp(log_std).tolist()).prior_rows())
        return _minus_twice_log(triangle, data, prior)

    reach = _DECADES * np.log(10.0)
    offsets = np.linspace(-reach, reach, _GRID)
    best = start.copy()
    for _ in range(2 if len(places) > 1 else 1):  # one strength after the other, then both together
        for k in range(len(places)):
            trials = [np.where(np.arange(len(places)) == k, start[k] + o, best) for o in offsets]
            best = trials[int(np.argmin([minus_twice(t) for t in trials]))]
    simplex = np.concatenate([best[None], best[None] + 0.5 * (offsets[1] - offsets[0]) * np.eye(len(best))])
    options = {"xatol": 1e-3, "fatol": 1e-4, "initial_simplex": simplex}
    bounds = [(s - reach, s + reach) for s in start]
    optimum = optimize.minimize(minus_twice, best, method="Nelder-Mead", bounds=bounds, options=options)
    at_edge = bool(np.any(np.abs(np.abs(optimum.x - start) - reach) < 0.01 * reach))
    names = [(model.channels[i].name, term.name) for (i, _), term in zip(places, terms, strict=True)]
    return Smoothness(dict(zip(names, np.exp(optimum.x).tolist(), strict=True)), at_edge)


def _minus_twice_log(triangle: np.ndarray, data: np.ndarray, prior: np.ndarray) -> float:
    """Without constants; the data outside the p rows are one of them."""
    design = np.concatenate([triangle, prior])
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    target = np.append(data, np.zeros(len(prior)))
    beta, *_ = np.linalg.lstsq(design / scale, target, rcond=None)
    left = target - (design / scale) @ beta
    both = np.linalg.svd(design / scale, compute_uv=False)
    alone = np.linalg.svd(prior / scale, compute_uv=False)
    # The rank of the prior does not depend on its strength; the scale does, but is in both determinants.
    alone = alone[alone > 1e-10 * alone[0]]
    both = both[both > 1e-14 * both[0]]
    log_both = 2.0 * float(np.sum(np.log(both))) + 2.0 * float(np.sum(np.log(scale)))
    log_alone = 2.0 * float(np.sum(np.log(alone)))
    if len(alone) == len(scale):
        log_alone += 2.0 * float(np.sum(np.log(scale)))
    else:
        # Pseudo-determinant in the plain coordinates.
        plain = np.linalg.svd(prior, compute_uv=False)
        log_alone = 2.0 * float(np.sum(np.log(plain[: len(alone)])))
    return float(left @ left) + log_both - log_alone
