"""The estimate of a whole unit: Gauss–Newton with the constant Jacobian and noise of the prediction.

The readings are not linear in all parameters: the effect of a sensor's error depends on the true attitude of the table.
So the forward model uses finite geometry, with the estimated errors of base, axes, mounting and encoders, and evaluates
the channels' terms at the resulting signals:

    r = y − h(β),    δ = argmin |W r − W J δ|² + |P (β + δ)|²,    β ← β + δ

with the whitened Jacobian `W J` at the nominal installation or at a first estimate. Each step reduces the error by a
factor of about the installation's error: 1 mrad gains three digits a step. Where h is curved between that point and the
estimate, by more than a part of the noise, J is taken again about the estimate: misalignments can stand for a
rotation of the body's frame, which products of small errors (`M(T) δ`) would seem to tell with the first J.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.imu_readings import ImuReadings
from gradcal_jax.estimation.solve import Estimate, Whitened, factored
from gradcal_jax.information import (
    NoiseSteps,
    Posterior,
    by_reading,
    estimator_of_means,
    imu_unweighted,
    row_of_steps,
    segments_of,
)

_ROUNDS = 12
# The change of an estimate, in standard deviations, below which its noise need not be found again.
_WEIGHED = 0.05
# Curvature between the point of linearisation and the estimate, in whitened residuals, beyond which J is taken again,
# at once beyond the second; and the most often.
_CURVED, _BENT, _LINEARISED = 0.5, 3.0, 20
# The iteration ends at a step that changes no parameter by more than this share of its standard deviation.
_SETTLED = 1e-3
# A step after which χ² is higher by more than this is halved, at most so many times.
_HIGHER, _HALVINGS = 1.0, 10
# Factor by which the angles' noise is narrowed to see which readings it absorbs, and the least part that counts.
_NARROWER, _ABSORBED = 0.5, 1e-6


class ImuEstimate(NamedTuple):
    """One unit's `estimate`, and its `white` rows, linearised about it, for those of the `R` rows that are
    `used`. `taken`: the same rows of an orthonormal basis of the fitted columns. `moved`: size of the last of the
    `rounds`, in standard deviations. `channel`: of each of the rows used, its number. `curved`: norm of what the
    whitened residuals differ from linear ones by.
    """

    estimate: Estimate
    white: Whitened
    used: np.ndarray
    taken: np.ndarray
    moved: float
    rounds: int
    channel: np.ndarray
    curved: float = 0.0

    @property
    def parameters(self) -> np.ndarray:
        """`(p,)`, in the engine's coordinates."""
        return self.estimate.parameters

    def residuals_of(self, channel: int) -> np.ndarray:
        """The whitened residuals of one channel's rows, in standard deviations."""
        return self.estimate.residuals[self.channel == channel]

    @property
    def known(self) -> Posterior:
        """Posterior of the parameters."""
        return self.estimate.known


def solve_imu(readings: ImuReadings, about: np.ndarray | None = None, *, settled: float = _SETTLED) -> ImuEstimate:
    """Parameters of a unit and its installation from its rows, with minimal norm in unobservable directions.

    `about`: approximate parameters in the engine's coordinates, the point of linearisation. `settled`: the share of its
    standard deviation by which no parameter changes at the last step. Errors: `ValueError` where no
    row is used, or one is not finite.
    """
    steps, columns = readings.linear(about)
    used = np.asarray(segments_of(readings.done.motion, readings.model).used)
    if not used.any():
        raise ValueError("no reading is left between two usable rows")
    if not np.isfinite(readings.observed[used]).all():
        raise ValueError("a reading that is used is not finite")
    estimate = _solved(readings, steps, columns, used, about, settled)
    return estimate if about is None else _linearised_again(readings, estimate, used, about)


def _linearised_again(readings: ImuReadings, estimate: ImuEstimate, used: np.ndarray, about: np.ndarray) -> ImuEstimate:
    """The estimate with noise steps and derivatives about itself, where those about `about` are not good enough. If it
    does not stand still, `moved` is what the last linearisation changed."""
    of = np.eye(len(about))
    for number in range(_LINEARISED + 1):
        at = estimate.parameters
        # Where channels see errors of angles by their own, the noise is that of the estimate, too.
        weighed = readings.free or not any(readings.sees_angles(at))
        if weighed and estimate.curved < _CURVED:
            break
        deviation = estimate.known.deviations(of)
        counted = np.isfinite(deviation) & (deviation > 0.0)
        change = float(np.max(np.abs(at - about)[counted] / deviation[counted], initial=0.0))
        if change <= _WEIGHED and estimate.curved < _CURVED:
            break
        if number == _LINEARISED:
            return estimate._replace(moved=max(estimate.moved, change))
        steps, columns = readings.linear(at)
        estimate, about = _solved(readings, steps, columns, used, at), at
    return estimate


def absorbed(steps: NoiseSteps, states: slice) -> np.ndarray:
    """`(N,)`: the part of every reading that the wide noise of the angles, at `states`, absorbs: by how much the
    logarithm of its variance grows with theirs, so that the parts add up to the number of angles."""
    n, per_std = steps.observation.shape[1], []
    for factor in (1.0, _NARROWER):
        scale = np.ones(n)
        scale[states] = factor
        both = scale[:, None] * scale
        of = steps._replace(covariance=steps.covariance * both, initial=steps.initial * both)
        per_std.append(by_reading(of, np.zeros((len(of.used), 0)))[1])
    wide, narrow = per_std
    ratio = np.divide(wide, narrow, out=np.ones(len(wide)), where=narrow > 0.0)
    return np.clip(np.log(ratio) / np.log(_NARROWER), 0.0, 1.0)


def angle_errors(readings: ImuReadings, parameters: np.ndarray) -> np.ndarray:
    """`(rows, L)`: where the table stands, the angle (rad) of every axis less that of the log, by the readings up to
    its next turn, for these parameters; NaN elsewhere. For readings whose angles are `free`."""
    steps, _ = readings.linear(parameters)
    motion = readings.done.motion
    at, row = segments_of(motion, readings.model), row_of_steps(motion, readings.model)
    apart = readings.by_steps(np.where(at.used, readings.observed - readings.expected(parameters), 0.0))
    states = by_reading(steps, apart[:, None])[0][:, readings.angle_states, 0]
    result = np.full((len(readings.log.time_s), motion.geometry.axis_count), np.nan)
    of_step = at.row_segment[np.maximum(row, 0)]
    for axis in range(motion.geometry.axis_count):
        moves = np.flatnonzero(motion.axis == axis)
        begins, ends = np.append(0, moves + 1), np.append(moves, len(motion.axis))
        for first, end in zip(begins, ends, strict=True):
            if end <= first:
                continue
            known = np.flatnonzero((at.first[of_step] >= first) & (at.first[of_step] < end) & (row >= 0))
            if len(known):
                result[readings.done.rows[first] : readings.done.rows[end] + 1, axis] = states[known[-1], axis]
    return result


def estimate_unweighted(readings: ImuReadings) -> ImuEstimate:
    """Parameters by ordinary least squares on the mean errors of the points of a standard plan, without priors and
    weights; the installation's errors are taken as zero, and count in the covariance."""
    motion, model = readings.done.motion, readings.model
    at, weighted = segments_of(motion, model), solve_imu(readings)
    steps, columns = readings.linear(None)
    estimator = estimator_of_means(motion, model, steps, columns)
    known = imu_unweighted(motion, model, readings.nominal())
    beta, deviation = np.zeros(model.size), known.deviations(np.eye(model.size))
    counted = np.isfinite(deviation) & (deviation > 0.0)
    # Scale factors multiply misalignments: the columns are those of an ideal sensor.
    for _ in range(_ROUNDS):
        apart = readings.by_steps(np.where(at.used, readings.observed - readings.expected(beta), 0.0))
        step = np.zeros(model.size)
        step[: model.calibrated] = estimator.back @ (estimator.weights.T @ apart)
        if np.max(np.abs(step[counted]) / deviation[counted], initial=0.0) <= _SETTLED:
            break
        beta = beta + step
    rest = weighted.white.data - weighted.white.rows @ beta
    fitted = weighted.estimate._replace(parameters=beta, known=known, residuals=rest)
    return weighted._replace(estimate=fitted)


def _solved(
    readings: ImuReadings,
    steps: NoiseSteps,
    columns: np.ndarray,
    used: np.ndarray,
    about: np.ndarray | None,
    settled: float = _SETTLED,
) -> ImuEstimate:
    """The estimate with these noise steps and derivatives `columns`, iterated from the parameters `about`."""
    model = readings.model
    kept = readings.by_steps(used)
    jacobian, prior = readings.whitened(steps, columns), model.prior_rows()
    design = np.concatenate([jacobian, prior])
    of = factored(design)
    known = of.known
    deviation = known.deviations(np.eye(model.size))
    counted = np.isfinite(deviation) & (deviation > 0.0)
    beta, moved, rounds = np.zeros(model.size) if about is None else about.copy(), np.inf, 0

    def left_over(beta: np.ndarray) -> tuple[np.ndarray, float]:
        apart = readings.by_steps(np.where(used, readings.observed - readings.expected(beta), 0.0))
        rest = readings.whitened(steps, apart[:, None])[:, 0]
        return rest, float(rest @ rest + np.sum((prior @ beta) ** 2))

    rest, squares = left_over(beta)
    first, begun, curved = rest, beta, 0.0
    while moved > settled and rounds < _ROUNDS and (about is None or curved < _BENT):
        step = of.fit(np.concatenate([rest, -prior @ beta]))
        now, after = left_over(beta + step)
        # A large error that is hardly observable, such as of the azimuth, would go past the minimum and away from it.
        for _ in range(_HALVINGS):
            if after <= squares + _HIGHER:
                break
            step = 0.5 * step
            now, after = left_over(beta + step)
        beta, rest, squares = beta + step, now, after
        moved = float(np.max(np.abs(step[counted]) / deviation[counted], initial=0.0))
        curved = float(np.linalg.norm(rest - first + jacobian @ (beta - begun)))
        rounds += 1
    degrees, taken = len(design) - len(of.singular), of.basis[: len(jacobian)]
    if readings.free:
        lost = absorbed(steps, readings.angle_states)[kept]
        degrees -= round(float(np.sum(lost)))
        taken = np.concatenate([taken, np.diag(np.sqrt(lost))[:, lost > _ABSORBED]], axis=1)
    estimate = Estimate(beta, known, rest, np.asarray(squares), degrees)
    white = Whitened(jacobian, rest + jacobian @ beta, prior)
    channel = segments_of(readings.done.motion, model).row_channel[used]
    return ImuEstimate(estimate, white, used, taken, moved, rounds, channel, curved)
