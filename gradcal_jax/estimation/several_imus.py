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
from gradcal_jax.estimation.imu_readings import ImuReadings
from gradcal_jax.estimation.imu_solve import ImuEstimate
from gradcal_jax.estimation.solve import factored
from gradcal_jax.information import NoiseSteps, Posterior, imu_system, segments_of, whiten
from gradcal_jax.information.posterior import OBSERVABLE
from gradcal_jax.model import BodyNodes, CommonScale, ImuModel, MountingError
from gradcal_jax.motion import TableMotion

# An axis whose encoder's error has less than this share of the largest variance draws nothing.
_NONE = 1e-14
# Numbers in the rows of one IMU with the columns of the encoder's errors.
_MOST = 5e7


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
    if len({len(part.vector) for part in parts}) > 1:
        raise ValueError("the logs of the IMUs have different readings of the encoder")
    whole, table = _whole(readings[0].model, shared[0], parts, [1] * len(parts))
    vector = np.sum([p.vector for p in parts], axis=0)
    scale, factor = _scaled_factor(whole)
    common = scale * cho_solve((factor, True), scale * vector)
    half = _root_of_inverse(scale, factor)
    joint = [_with(*of, common, half, table) for of in zip(solutions, parts, shared, strict=True)]
    tests = [_agreement(of, whole, vector, table) if len(parts) > 1 else None for of in parts]
    return SeveralImus(joint, tests)


def posteriors_together(
    plans: Sequence[tuple[ImuModel, TableMotion, BodyNodes, Posterior]], counts: Sequence[int], *, clock: bool = True
) -> list[Posterior]:
    """The posterior of an IMU of each kind after one motion of the table, estimated together with all others: model,
    motion, nodes and the posterior of one alone, and how many there are of each kind.

    Errors: `MemoryError` for a plan with more readings than can be held, with the errors of the encoder at each.
    """
    parts, shared = [], []
    for model, motion, nodes, _ in plans:
        steps, columns = imu_system(motion, model, nodes)
        shared.append(shared_parameters(model, clock=clock))
        if (drawn := np.count_nonzero(np.any(np.asarray(steps.covariance)[:, model.own_states :], axis=(1, 2)))) and (
            drawn * len(columns) > _MOST
        ):
            raise MemoryError(
                f"the plan has {len(columns)} readings and {drawn} errors of the encoders, too many to predict the "
                "estimate of all IMUs together"
            )
        nothing = np.zeros(len(columns)), np.zeros(model.size)
        parts.append(_without_own(model, steps, columns, shared[-1], *nothing))
    whole, table = _whole(plans[0][0], shared[0], parts, counts)
    half = _root_of_inverse(*_scaled_factor(whole))
    spreads = [_spread(part, own, half, table) for part, own in zip(parts, shared, strict=True)]
    return [Posterior(spread, alone.hidden) for spread, (*_, alone) in zip(spreads, plans, strict=True)]


def _whole(
    model: ImuModel, shared: np.ndarray, parts: Sequence[_Reduced], counts: Sequence[int]
) -> tuple[np.ndarray, int]:
    """The information on s from all IMUs and the priors, and how many of s are the table's."""
    prior = np.concatenate([np.zeros(0), *(np.asarray(term.stds) for term in model.installation)])
    prior = prior[shared[model.calibrated :]]
    table = len(prior)
    own = np.concatenate([prior**-2.0, np.ones(len(parts[0].vector) - table)])
    return np.diag(own) + sum(n * part.information for n, part in zip(counts, parts, strict=True)), table


def _scaled_factor(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scale and lower triangle of `information = diag(1/scale) L Lᵀ diag(1/scale)`."""
    scale = 1.0 / np.sqrt(np.diag(information))
    return scale, cholesky(information * scale[:, None] * scale, lower=True)


def _root_of_inverse(scale: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """A square root of the covariance."""
    return scale[:, None] * solve_triangular(factor, np.eye(len(scale)), lower=True).T


def _reduced(readings: ImuReadings, solution: ImuEstimate, shared: np.ndarray) -> _Reduced:
    motion, model = readings.done.motion, readings.model
    steps, columns = readings.linear(solution.parameters)
    used = np.asarray(segments_of(motion, model).used)
    apart = np.where(used, readings.observed - readings.expected(solution.parameters), 0.0)
    common = None if readings.common is None else readings.by_steps(readings.common)
    return _without_own(model, steps, columns, shared, readings.by_steps(apart), solution.parameters, common)


def _without_own(
    model: ImuModel,
    steps: NoiseSteps,
    columns: np.ndarray,
    shared: np.ndarray,
    apart: np.ndarray,
    about: np.ndarray,
    common: np.ndarray | None = None,
) -> _Reduced:
    """The rows of an IMU, `apart` from what is expected `about` its parameters, in the order of the noise steps;
    `common`: further errors of the table, of variance one."""
    errors = _encoder_columns(model, steps)
    errors = errors if common is None else np.concatenate([errors, common], axis=1)
    # The filter of the IMU's own noise: the encoder's states neither move nor are seen.
    own = slice(model.own_states, None)
    covariance, initial, observed = (np.array(x) for x in (steps.covariance, steps.initial, steps.observation))
    covariance[:, own, :], covariance[:, :, own], initial[own, :], initial[:, own] = 0.0, 0.0, 0.0, 0.0
    observed[:, own] = 0.0
    quiet = steps._replace(covariance=covariance, initial=initial, observation=observed)
    white = np.asarray(whiten(quiet, np.concatenate([apart[:, None], columns, errors], axis=1)))
    white = white[np.asarray(steps.used)]
    size = model.size
    jacobian = white[:, 1 : 1 + size]
    data = white[:, 0] + jacobian @ about
    prior = np.asarray(model.prior_rows())
    of_own = ~np.any(prior[:, shared] != 0.0, axis=1)
    rows = np.concatenate([jacobian[:, ~shared], prior[of_own][:, ~shared]])
    of = factored(rows)
    basis = of.basis[: len(jacobian)]
    others = np.concatenate([jacobian[:, shared], white[:, 1 + size :]], axis=1)
    through, rotated = basis.T @ others, basis.T @ data
    information = others.T @ others - through.T @ through
    vector = others.T @ data - through.T @ rotated
    return _Reduced(np.flatnonzero(~shared), rotated, through, of.known.spread, information, vector)


def _encoder_columns(model: ImuModel, steps: NoiseSteps) -> np.ndarray:
    """`(N, u)`: what each innovation of the encoders' errors, of variance one, adds to every row."""
    own = slice(model.own_states, None)
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
    known = Posterior(_spread(part, shared, half, table), solution.known.hidden)
    return solution._replace(estimate=solution.estimate._replace(parameters=parameters, known=known))


def _spread(part: _Reduced, shared: np.ndarray, half: np.ndarray, table: int) -> np.ndarray:
    """The spread `(p, p)` of an IMU's parameters, with the square root `half` of the covariance of s."""
    spread = np.zeros((len(shared), part.back.shape[1] + half.shape[1]))
    spread[part.own, : part.back.shape[1]] = part.back
    spread[part.own, part.back.shape[1] :] = -part.back @ (part.through @ half)
    spread[shared, part.back.shape[1] :] = half[:table]
    return np.asarray(np.linalg.qr(spread.T, mode="r")).T


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
