"""The information of a plan, and its posterior: `BuiltImu` in, `SquareRootInformation` and `Posterior` out."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.information.gears import rows_of_gears
from gradcal_jax.information.imu_rows import Segments, imu_system, row_of_steps, rows_of_terms, segments_of
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.posterior import (
    LeastSquares,
    Posterior,
    SquareRootInformation,
    least_squares_of_means,
    noise_of_sums,
    posterior,
    spread_of,
    square_root,
)
from gradcal_jax.information.whitening import SINGLE_PRECISION, whiten, whitened_factor
from gradcal_jax.model import BodyNodes, ImuModel
from gradcal_jax.model.build import BuiltImu, unweighted_estimator
from gradcal_jax.model.terms import Term, block_diagonal
from gradcal_jax.motion import TableMotion, frames


def imu_posterior(built: BuiltImu) -> Posterior:
    """The posterior of a unit after its plan and the motions before it, by the estimator that the spec names."""
    if unweighted_estimator(built.spec):
        return imu_unweighted(built.motion, built.model, built.body_nodes())
    return posterior(plan_information(built)[0])


def plan_information(
    built: BuiltImu, beside: Sequence[tuple[int, Term]] = (), at: Segments | None = None
) -> tuple[SquareRootInformation, Any]:
    """`imu_information` of a plan on a table whose gears' errors are unknown."""
    motion, of, nodes = built.motion, built.model, built.body_nodes()
    common = rows_of_gears(motion, of, nodes, built.gears, at)[1] if built.gears else None
    return imu_information(motion, of, nodes, beside, common, at)


class RestPoses(NamedTuple):
    """The `n` rests of a plan: `start` and `duration` s, and `up` `(n, 3)`, the vertical seen from the body."""

    start: np.ndarray
    duration: np.ndarray
    up: np.ndarray


def rest_poses(built: BuiltImu) -> RestPoses:
    """The rests of a plan."""
    motion = built.motion
    line, at = motion.line, segments_of(motion, built.model)
    before, _ = motion.angles()
    stages = frames(motion.geometry, before, motion.mounting)
    rests = (at.axis < 0) & ~line.gap[at.first]
    first = at.first[rests]
    return RestPoses(line.start[first], at.sums(line.duration)[rests], stages.attitude[first][:, 2, :])


def imu_information(
    motion: TableMotion,
    model: ImuModel,
    nodes: BodyNodes,
    beside: Sequence[tuple[int, Term]] = (),
    common: AnyArray | None = None,
    at: Segments | None = None,
) -> tuple[SquareRootInformation, Float[AnyArray, "p k"]]:
    """The information of a motion's rows and of the priors about the parameters of the unit and its installation; and
    the estimate's answers to further errors: by how much it is off for one unit of each of the terms `beside` (number
    of a channel, and a term of one parameter), which it does not know. With a the whitened column of one, `v = C Φᵀa`.
    `common` `(R, k)`: by how much unknown errors of one standard deviation change the rows. `at`: the segments, where
    they are traced. Errors: `ValueError` in single precision."""
    at = segments_of(motion, model) if at is None else at
    further = rows_of_terms(model, nodes, at, beside)
    steps, columns = imu_system(motion, model, nodes, at, common, further)
    if columns.dtype != np.float64:
        raise ValueError(SINGLE_PRECISION)
    count = 0 if common is None else common.shape[1]
    below = block_diagonal([np.eye(count), model.prior_rows()])
    if namespace(steps, columns, below) is np:
        white, p = whiten(steps, columns), below.shape[1]
        whole, product = square_root(np.concatenate([white[:, :p], below])), white[:, :p].T @ white[:, p:]
        spread = posterior(whole).spread
        return whole.without(count), (spread @ (spread.T @ product))[count:]
    *of, product = whitened_factor(steps, columns, jnp.asarray(below))
    whole = SquareRootInformation(*of)
    return whole.without(count), (whole.covariance() @ product)[count:] if beside else product[count:]


def imu_unweighted(motion: TableMotion, model: ImuModel, nodes: BodyNodes) -> Posterior:
    """Covariance of ordinary least squares on the mean errors of all points of a standard plan. The installation's
    errors are noise: nothing is known of them but their priors, which such an estimate does not use."""
    steps, columns = imu_system(motion, model, nodes)
    own, estimator = model.calibrated, estimator_of_means(motion, model, steps, columns)
    stds = [term.stds for term in model.installation]
    shared = (estimator.weights.T @ columns[:, own:]) * np.concatenate([*stds, np.zeros(0)])
    known = spread_of(estimator, noise_of_sums(steps, estimator.weights, [steps.noise()])[0] + shared @ shared.T)
    beyond = [(0, model.size - own), (0, 0)]
    return Posterior(np.pad(known.spread, beyond), np.pad(known.hidden, beyond))


def estimator_of_means(
    motion: TableMotion, model: ImuModel, steps: NoiseSteps, columns: Float[AnyArray, "R p"]
) -> LeastSquares:
    """Ordinary least squares of the calibrated parameters on the mean errors of all points of a standard plan."""
    at, row = segments_of(motion, model), row_of_steps(motion, model)
    duration = at.sums(motion.line.duration)[at.row_segment[np.maximum(row, 0)]]
    return least_squares_of_means(columns[:, : model.calibrated], np.asarray(steps.used), duration)
