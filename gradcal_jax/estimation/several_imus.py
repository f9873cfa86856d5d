"""Several IMUs on one table together: what they share is estimated once, from all of them.

Shared are the errors of the table (tilt of its base, axes, encoder errors by angle, gravity; the clock if it is the
computer's) and the encoder's error at each standstill or reading. An IMU sees the latter as the states of its noise
system (`information.imu_rows`); their innovations, with variance one, become parameters `u` here, whose columns follow
from the same steps. Given table and encoder the IMUs are independent:

    z_i = A_i θ_i + B_i s + noise of its own,     s = (table, u)

`θ_i` is eliminated from each by one QR factorisation, the sum of what is left is the information on s, and every IMU
has back its share of it: the exact joint least squares, in a time that is linear in the number of IMUs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.imu_solve import ImuEstimate, ImuReadings
from gradcal_jax.information import Posterior, segments_of, whiten
from gradcal_jax.information.posterior import OBSERVABLE
from gradcal_jax.model import CommonScale, ImuModel, MountingError

# An axis whose encoder's error has less than this share of the largest variance draws nothing.
_NONE = 1e-14


class SeveralImus(NamedTuple):
    """`solutions` of the IMUs, each with all that is known of the shared errors, and `agreement`: a test of each, that
    its table is the one that all others see (None where it says nothing of the table alone)."""

    solutions: list[ImuEstimate]
    agreement: list[Test | None]


class _Reduced(NamedTuple):
    """An IMU without its own parameters: `triangle` R and `rotated` Qᵀz of them, `through` Qᵀ[B E], the `information`
    and the `vector` on s, and its observable inverse `back` of R."""

    own: np.ndarray
    rotated: np.ndarray
    through: np.ndarray
    back: np.ndarray
    information: np.ndarray
    vector: np.ndarray


def shared_parameters(model: ImuModel, *, clock: bool) -> np.ndarray:
    """Which parameters are of the table, `(p,)`; `clock`: the clock is the computer's, one for all IMUs."""
    parts = [np.zeros(model.calibrated, bool)]
    for term in model.installation:
        own = isinstance(term, MountingError) or (isinstance(term, CommonScale) and term.of != "gravity" and not clock)
        parts.append(np.full(term.size, not own))
    return np.concatenate(parts)


def solve_together(
    readings: Sequence[ImuReadings], solutions: Sequence[ImuEstimate], *, clock: bool = True
) -> SeveralImus:
    """The joint estimate of IMUs whose own ones are `solutions`, about which all is linear.

    Errors: `ValueError` for IMUs whose logs have other moves, or whose models have other errors of the table.
    """
    shared = [shared_parameters(of.model, clock=clock) for of in readings]
    axes = [segments_of(of.done.motion, of.model).axis for of in readings]
    if any(len(a) != len(axes[0]) or np.any(a != axes[0]) for a in axes):
        raise ValueError("the logs of the IMUs have different moves, so their encoder errors are not the same")
    parts = [_reduced(*of) for of in zip(readings, solutions, shared, strict=True)]
    first = readings[0].model
    prior = np.concatenate([np.zeros(0), *(np.asarray(term.stds) for term in first.installation)])
    prior = prior[shared[0][first.calibrated :]]
    table = len(prior)
    own_prior = np.concatenate([prior**-2.0, np.ones(len(parts[0].vector) - table)])
    if len({len(part.vector) for part in parts}) > 1:
        raise ValueError("the logs of the IMUs have different readings of the encoder")
    whole = np.diag(own_prior) + np.sum([p.information for p in parts], axis=0)
    vector = np.sum([p.vector for p in parts], axis=0)
    scale = 1.0 / np.sqrt(np.diag(whole))
    factor = cholesky(whole * scale[:, None] * scale, lower=True)
    common = scale * cho_solve((factor, True), scale * vector)
    half = scale[:, None] * solve_triangular(factor, np.eye(len(scale)), lower=True).T
    joint = [_with(*of, common, half, table) for of in zip(solutions, parts, shared, strict=True)]
    tests = [_agreement(of, whole, vector, table) if len(parts) > 1 else None for of in parts]
    return SeveralImus(joint, tests)


def _reduced(readings: ImuReadings, solution: ImuEstimate, shared: np.ndarray) -> _Reduced:
    model = readings.model
    steps, columns = readings.linear(solution.parameters)
    errors = _encoder_columns(readings, steps)
    channels = sum(1 + c.model.processes.count for c in model.channels)
    # The filter of the IMU's own noise: the encoder's states neither move nor are seen.
    own = slice(channels, None)
    covariance, initial, observed = (np.array(x) for x in (steps.covariance, steps.initial, steps.observation))
    covariance[:, own, :], covariance[:, :, own], initial[own, :], initial[:, own] = 0.0, 0.0, 0.0, 0.0
    observed[:, own] = 0.0
    quiet = steps._replace(covariance=covariance, initial=initial, observation=observed)
    used = np.asarray(segments_of(readings.done.motion, model).used)
    apart = readings.by_steps(np.where(used, readings.observed - readings.expected(solution.parameters), 0.0))
    kept = readings.by_steps(used)
    white = np.asarray(whiten(quiet, np.concatenate([apart[:, None], columns, errors], axis=1)))[kept]
    size = model.size
    jacobian = white[:, 1 : 1 + size]
    data = white[:, 0] + jacobian @ solution.parameters
    prior = np.asarray(model.prior_rows())
    of_own = ~np.any(prior[:, shared] != 0.0, axis=1)
    rows = np.concatenate([jacobian[:, ~shared], prior[of_own][:, ~shared]])
    norm = np.linalg.norm(rows, axis=0)
    norm = np.where(norm > 0.0, norm, 1.0)
    orthogonal, triangle = np.linalg.qr(rows / norm)
    left, spread, right = np.linalg.svd(triangle)
    seen = spread > OBSERVABLE * spread[0]
    basis = orthogonal[: len(jacobian)] @ left[:, seen]
    back = (right[seen].T / spread[seen]) / norm[:, None]
    others = np.concatenate([jacobian[:, shared], white[:, 1 + size :]], axis=1)
    through, rotated = basis.T @ others, basis.T @ data
    information = others.T @ others - through.T @ through
    vector = others.T @ data - through.T @ rotated
    return _Reduced(np.flatnonzero(~shared), rotated, through, back, information, vector)


def _encoder_columns(readings: ImuReadings, steps) -> np.ndarray:
    """`(N, u)`: what each innovation of the encoders' errors, of variance one, adds to every row."""
    channels = sum(1 + c.model.processes.count for c in readings.model.channels)
    own = slice(channels, None)
    transition = np.asarray(steps.transition)[:, own, own]
    covariance = np.asarray(steps.covariance)[:, own, own]
    observed = np.asarray(steps.observation)[:, own]
    initial = np.asarray(steps.initial)[own, own]
    largest = max(float(np.max(np.abs(x), initial=0.0)) for x in (covariance, initial))
    draws = [_root(initial, largest)]
    draws += [_root(q, largest) if q.any() else q[:, :0] for q in covariance]
    total = sum(draw.shape[1] for draw in draws)
    result, state = np.zeros((len(observed), total)), np.zeros((observed.shape[1], total))
    begin = draws[0].shape[1]
    state[:, :begin] = draws[0]
    for k, draw in enumerate(draws[1:]):
        state[:, :begin] = transition[k] @ state[:, :begin]
        state[:, begin : begin + draw.shape[1]] += draw
        begin += draw.shape[1]
        result[k, :begin] = observed[k] @ state[:, :begin]
    return result


def _root(covariance: np.ndarray, largest: float) -> np.ndarray:
    """A square root of a covariance, a column for each direction that has a variance."""
    values, vectors = np.linalg.eigh(covariance)
    seen = values > _NONE * largest
    return vectors[:, seen] * np.sqrt(values[seen])


def _with(
    solution: ImuEstimate, part: _Reduced, shared: np.ndarray, common: np.ndarray, half: np.ndarray, table: int
) -> ImuEstimate:
    """The estimate of an IMU with what all say of the shared errors."""
    parameters = np.array(solution.parameters)
    parameters[part.own] = part.back @ (part.rotated - part.through @ common)
    parameters[shared] = common[:table]
    spread = np.zeros((len(parameters), part.back.shape[1] + half.shape[1]))
    spread[part.own, : part.back.shape[1]] = part.back
    spread[part.own, part.back.shape[1] :] = -part.back @ (part.through @ half)
    spread[shared, part.back.shape[1] :] = half[:table]
    triangle = np.asarray(np.linalg.qr(spread.T, mode="r"))
    known = Posterior(triangle.T, solution.known.hidden)
    return solution._replace(estimate=solution.estimate._replace(parameters=parameters[None], known=(known,)))


def _agreement(part: _Reduced, whole: np.ndarray, vector: np.ndarray, table: int) -> Test | None:
    """Whether an IMU sees the table of all others: χ² of the difference of both estimates, in the directions that it
    determines. The encoder's errors are common, so that the difference is, if anything, smaller than by chance."""
    if not table:
        return None
    alone = part.information + np.diag(np.concatenate([np.zeros(table), np.ones(len(vector) - table)]))
    own, of_own = _marginal(alone, part.vector, table)
    others, of_others = _marginal(whole - part.information, vector - part.vector, table)
    deviation = 1.0 / np.sqrt(np.diag(others))
    values, vectors = np.linalg.eigh(own * deviation[:, None] * deviation)
    seen = values > OBSERVABLE
    if not seen.any():
        return None
    direction = deviation[:, None] * vectors[:, seen]
    back = np.linalg.inv(direction.T @ own @ direction)
    along = np.linalg.pinv(direction)
    apart = back @ (direction.T @ of_own) - along @ np.linalg.solve(others, of_others)
    together = back + along @ np.linalg.inv(others) @ along.T
    return chi_squared_test(float(apart @ np.linalg.solve(together, apart)), int(np.count_nonzero(seen)))


def _marginal(information: np.ndarray, vector: np.ndarray, table: int) -> tuple[np.ndarray, np.ndarray]:
    """Information and vector of the table's errors alone."""
    rest = information[table:, table:]
    if not len(rest):
        return information, vector
    solved = np.linalg.solve(rest, np.concatenate([information[table:, :table], vector[table:, None]], axis=1))
    across = information[:table, table:]
    return information[:table, :table] - across @ solved[:, :-1], vector[:table] - across @ solved[:, -1]
