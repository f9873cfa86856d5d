"""The errors of an IMU's calibration in its own covariance, and what the data say of the truth."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.fit_of_log import Fit
from gradcal_jax.information import segments_of, whiten
from gradcal_jax.model import AXIS_NAMES, SCALE_FACTOR, ImuModel
from gradcal_jax.model.build import MISALIGNMENT

# Steps of Gauss and Newton for what is no part of a calibration: the second one changes χ² by 1e-3.
_STEPS = 3
# Of differences, in the engine's coordinates.
_STEP = 1e-6


def nees_of(names: Sequence[str], values: np.ndarray, truth: np.ndarray, covariance: np.ndarray) -> float:
    """The normalised square of the errors of coefficients (`gyro_x.m_y`, SI) by a covariance `(n, n)`.

    A plan may tell the element (1 + M) m of a sensor's matrix, a polynomial in temperature, far better than M and m:
    the errors of its coefficients, no sums of theirs where both are large, are taken in the place of those of m.
    """
    errors = values - truth
    slopes, pairs = _of_elements(names, values)
    for k, m, scale in pairs:
        errors[k] += values[scale] * values[m] - truth[scale] * truth[m]
    covariance = slopes @ covariance @ slopes.T
    # Scaled, since coefficients have many units.
    size = np.sqrt(np.diag(covariance))
    return float((errors / size) @ np.linalg.solve(covariance / np.outer(size, size), errors / size))


def deviations_of_elements(names: Sequence[str], values: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations of coefficients, those of (1 + M) m in the place of those of m."""
    slopes, _ = _of_elements(names, values)
    return np.sqrt(np.diag(slopes @ covariance @ slopes.T))


def _of_elements(names: Sequence[str], values: np.ndarray) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    """The derivatives of the coefficients of (1 + M) m, and of other coefficients, by all; and the places of which the
    first has the product of the others added."""
    slopes, pairs = np.eye(len(names)), list[tuple[int, int, int]]()
    where = {name: k for k, name in enumerate(names)}
    for k, name in enumerate(names):
        channel, _, symbol = name.partition(".")
        if (of := re.fullmatch(r"(m_[xyz])(\d?)", symbol)) is None:
            continue
        degree = int(of[2] or 0)
        for lower in range(degree + 1):
            known = (f"{channel}.{s}" for s in (f"b0{degree - lower}", f"s{degree - lower}", "s" * (lower == degree)))
            scale = next((where[s] for s in known if s in where), None)
            m = where.get(f"{channel}.{of[1]}{lower if of[2] else ''}")
            if scale is not None and m is not None:
                pairs.append((k, m, scale))
                slopes[k, m] += values[scale]
                slopes[k, scale] += values[m]
    return slopes, pairs


class ByData(NamedTuple):
    """What the data say of the true coefficients, each a χ² of as many degrees of freedom as there are coefficients.

    `squares`: weighted squares of data and priors at the truth above those of the estimate; it says nothing of the
    estimate's covariance. `nees`: the errors that the model's own difference between truth and estimate amounts to, in
    the covariance given.
    """

    squares: float
    nees: float


def by_data(fit: Fit, truth: dict[str, float], names: Sequence[str], covariance: np.ndarray) -> ByData:
    """χ² of the true coefficients (SI) of some `names`, with their `covariance`.

    Of what is not named (the table's own errors, what depends on past temperatures) all is fitted anew at the truth.
    Where a plan tells products of coefficients better than each (a second-order term times a misalignment, a
    misalignment times the table's azimuth), errors in a linear covariance are no χ², however right both are. So the
    difference of what the model expects, whitened, `d`, is taken in their place: `bᵀPb` with `b = Aᵀd`, A being the
    estimate's own whitened columns. Where the model is linear `b = P⁻¹e`, and this is `eᵀP⁻¹e`.
    """
    readings, estimate = fit.readings, fit.solution.parameters
    model = readings.model
    priors, of_all = np.asarray(model.prior_rows()), list(model.names())
    named = np.array([of_all.index(name) for name in names])
    others = np.setdiff1d(np.arange(model.size), named)
    steps, _ = readings.linear(estimate)
    used = segments_of(readings.done.motion, model).used
    of_steps = readings.by_steps(np.asarray(used))

    def white(rows: np.ndarray) -> np.ndarray:
        return np.asarray(whiten(steps, np.where(of_steps[:, None], rows, 0.0)))[of_steps]

    def left(parameters: np.ndarray) -> np.ndarray:
        apart = readings.by_steps(np.where(used, readings.observed - readings.expected(parameters), 0.0))
        return np.concatenate([white(apart[:, None])[:, 0], -priors @ parameters])

    def columns(parameters: np.ndarray) -> np.ndarray:
        return np.concatenate([white(readings.linear(parameters)[1]), priors])

    reported = np.asarray(model.to_reported)
    values = reported @ estimate
    values[named] = [truth[name] for name in names]
    to_engine = np.linalg.inv(reported)
    for _ in range(_STEPS if len(others) else 0):
        here = to_engine @ values
        free = (columns(here) @ to_engine)[:, others]
        size = np.sqrt(np.sum(free**2, axis=0))
        values[others] += np.linalg.lstsq(free / size, left(here), rcond=None)[0] / size
    at_truth, at_estimate = left(to_engine @ values), left(estimate)
    slopes = columns(estimate) @ to_engine
    own = slopes[:, named]
    if len(others):  # less what the others can take
        basis = np.linalg.qr(slopes[:, others])[0]
        own = own - basis @ (basis.T @ own)
    size = np.sqrt(np.diag(covariance))
    along = (own * size).T @ (at_truth - at_estimate)
    return ByData(
        float(np.sum(at_truth**2) - np.sum(at_estimate**2)),
        float(along @ (covariance / np.outer(size, size)) @ along),
    )


def along_after_correction(
    model: ImuModel, estimate: np.ndarray, truth: np.ndarray, temperatures: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the correction of the gyros by an estimate leaves of a rate along each axis, `(3 n_T,)`: the diagonal of
    A⁻¹ A_true - 1 with A = (1 + M)(1 + m) at rate zero; and its derivatives by the estimate, differences `(3 n_T, p)`.

    Unlike the coefficients of M it does not depend on how the body's frame is turned, of which a plan without an
    encoder may know little. Parameters in the engine's coordinates; temperatures in °C.
    """

    def matrices(parameters: np.ndarray) -> np.ndarray:
        result = np.zeros((len(temperatures), 3, 3))
        for i in range(3):
            (channel,) = (c for c in model.channels if (c.kind, c.axis) == ("gyro", i))
            own = parameters[model.where("gyro", i)]
            scale = channel.map(SCALE_FACTOR)
            assert scale is not None
            at_rest = scale.values(temperatures, np.zeros(len(temperatures)))
            result[:, i, i] = 1.0
            for j in range(3):
                if (term := channel.map(MISALIGNMENT.format(AXIS_NAMES[j]))) is not None:
                    result[:, i, j] += term.temperature(temperatures) @ own[channel.where(term.name)]
            result[:, i] *= 1.0 + (at_rest @ own[channel.where(scale.name)])[:, None]
        return result

    def left(parameters: np.ndarray, true: np.ndarray) -> np.ndarray:
        apart = np.linalg.solve(matrices(parameters), matrices(true)) - np.eye(3)
        return np.diagonal(apart, axis1=1, axis2=2).ravel()

    steps = _STEP * np.eye(len(estimate))
    slopes = [(left(estimate + step, estimate) - left(estimate - step, estimate)) / (2.0 * _STEP) for step in steps]
    return left(estimate, truth), np.stack(slopes, axis=1)
