"""Calibration without a structure: strength of the smoothness prior by marginal likelihood.

A map of bins or B-splines has a prior on the differences of neighbouring coefficients, `D β ~ N(0, s²)`. Too large
an s fits the noise, too small an s smooths the map away. The likelihood of the data with β integrated out,

    −2 ln p(z | s) = min_β (|z − A β|² + |P_s β|²) + ln det(AᵀA + P_sᵀP_s) − ln pdet(P_sᵀP_s) + const,

P_s the rows of all priors, balances both (empirical Bayes; with directions without a prior it is the restricted
likelihood). Each value costs one small factorisation, since the data are first reduced to p rows.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy import optimize

from gradcal_jax.estimation.solve import Whitened
from gradcal_jax.model import SensorModel

_GRID = 13
_DECADES = 3.0


class Smoothness(NamedTuple):
    """Chosen standard deviations of neighbours' differences, in rad/s and as a ratio (None: a map without this prior).

    `at_edge`: whether one of them is at the edge of the searched range, so that the data do not determine it.
    """

    bias: float | None
    scale_factor: float | None
    at_edge: bool


def with_smoothness(model: SensorModel, bias: float | None, scale_factor: float | None) -> SensorModel:
    """The model with other standard deviations of the smoothness priors that it has."""
    if bias is not None and model.bias is not None:
        model = eqx.tree_at(lambda m: m.bias.smoothness_std, model, np.asarray(bias, dtype=float))
    if scale_factor is not None and model.scale is not None:
        model = eqx.tree_at(lambda m: m.scale.smoothness_std, model, np.asarray(scale_factor, dtype=float))
    return model


def choose_smoothness(white: Whitened, model: SensorModel, unit: int = 0) -> Smoothness:
    """The strength at which one unit's data are most probable.

    Searched within three decades about the strengths of the model. Errors: `ValueError` for a model without a
    smoothness prior.
    """
    now = [
        float(of.smoothness_std) if of is not None and of.has_smoothness else None for of in (model.bias, model.scale)
    ]
    free = [k for k, value in enumerate(now) if value is not None]
    if not free:
        raise ValueError("no map of this model has a smoothness prior: give B-splines or bins with one")
    rows = white.rows_of(unit)
    orthogonal, triangle = np.linalg.qr(rows)
    data = orthogonal.T @ white.data[unit]
    start = np.log([value for value in now if value is not None])

    def strengths(log_std: np.ndarray) -> list[float | None]:
        values = dict(zip(free, np.exp(log_std).tolist(), strict=True))
        return [values.get(0), values.get(1)]

    def minus_twice(log_std: np.ndarray) -> float:
        prior = np.asarray(with_smoothness(model, *strengths(log_std)).prior_rows())
        return _minus_twice_log(triangle, data, prior)

    reach = _DECADES * np.log(10.0)
    offsets = np.linspace(-reach, reach, _GRID)
    best = start.copy()
    for _ in range(2 if len(free) > 1 else 1):  # one strength after the other, then both together
        for k in range(len(free)):
            trials = [np.where(np.arange(len(free)) == k, start[k] + o, best) for o in offsets]
            best = trials[int(np.argmin([minus_twice(t) for t in trials]))]
    simplex = np.concatenate([best[None], best[None] + 0.5 * (offsets[1] - offsets[0]) * np.eye(len(best))])
    options = {"xatol": 1e-3, "fatol": 1e-4, "initial_simplex": simplex}
    bounds = [(s - reach, s + reach) for s in start]
    optimum = optimize.minimize(minus_twice, best, method="Nelder-Mead", bounds=bounds, options=options)
    at_edge = bool(np.any(np.abs(np.abs(optimum.x - start) - reach) < 0.01 * reach))
    bias, scale_factor = strengths(optimum.x)
    return Smoothness(bias, scale_factor, at_edge)


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
