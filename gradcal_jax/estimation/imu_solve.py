"""The estimate of an IMU: Gauss–Newton with the Jacobian and the noise of the prediction.

The readings are not linear in all parameters: the effect of a sensor's error depends on the true attitude of the table.
So the forward model uses finite geometry, with the estimated errors of base, axes, mounting and encoders:

    r = y − h(β),    δ = argmin |W r − W J δ|² + |P (β + δ)|²,    β ← β + δ,    C = (JᵀWᵀW J + PᵀP)⁻¹

with the whitened Jacobian `W J` and the whitened rows `P` of the priors. `C` is the covariance that `predict` predicts,
for the executed motion, and the whitened residuals are the normalised innovations of the noise's Kalman filter:
independent with variance 1 where the model is true. Each step reduces the error by a factor of about the installation's
error: 1 mrad gains three digits a step. Where h is curved between the point of linearisation and the estimate, by more
than a part of the noise, J is taken again about the estimate: misalignments can stand for a rotation of the body's
frame, which products of small errors (`M(T) δ`) would seem to observe with the first J.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.imu_readings import ImuReadings
from gradcal_jax.information import NoiseSteps, Posterior, by_reading
from gradcal_jax.information.posterior import known_of

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
# Factor by which the angles' noise is narrowed to see which readings it absorbs.
_NARROWER = 0.5


class Whitened(NamedTuple):
    """Rows of variance one, of the readings used: `rows` `(n, p)`, `data` `(n,)`. `prior` `(q, p)`: whitened rows of
    the prior, whose data are zero."""

    rows: np.ndarray
    data: np.ndarray
    prior: np.ndarray


class ImuEstimate(NamedTuple):
    """`parameters` `(p,)`, in the engine's coordinates, with their posterior; `residuals` `(n,)`: whitened, of the rows
    used; `chi_squared` counts the priors' rows too and has `degrees` degrees of freedom. `white`: linearised about it.
    `used` `(R,)`: which rows are; `channel` and `leverage` `(n,)` of those: the channel's number, and the part of the
    reading's variance that the fit takes up. `moved`: the largest change of the last of the `rounds`, in standard
    deviations. `curved`: norm of what the whitened residuals differ from linear ones by."""

    parameters: np.ndarray
    known: Posterior
    residuals: np.ndarray
    chi_squared: float
    degrees: int
    white: Whitened
    used: np.ndarray
    channel: np.ndarray
    leverage: np.ndarray
    moved: float
    rounds: int
    curved: float

    @property
    def test(self) -> Test:
        """The χ² test of the fit."""
        return chi_squared_test(self.chi_squared, self.degrees)

    @property
    def noise_scale(self) -> float:
        """√(χ²/degrees), the factor by which the noise differs from the spec."""
        return float(np.sqrt(self.chi_squared / self.degrees)) if self.degrees > 0 else float("nan")

    @property
    def excess(self) -> float:
        """χ² over degrees of freedom where it is above 1."""
        return max(self.chi_squared / max(self.degrees, 1), 1.0)


class Factored(NamedTuple):
    """A design `(n, p)` with columns of length one, Q L diag(singular) directions: `known`, the posterior of variance
    one, and `basis` `(n, r)`, orthonormal, of what its columns span."""

    basis: np.ndarray
    singular: np.ndarray
    directions: np.ndarray
    scale: np.ndarray
    known: Posterior

    def fit(self, data: np.ndarray) -> np.ndarray:
        """The parameters of minimal norm for data `(n,)`."""
        return self.directions.T @ ((self.basis.T @ data) / self.singular) / self.scale


def factored(design: np.ndarray) -> Factored:
    """The factors of a design, whose unobservable directions are `known.hidden`.

    As `information.square_root` and `posterior`, but by NumPy's QR, since shapes vary and nothing is differentiated.
    """
    norm = np.linalg.norm(design, axis=0)
    scale = np.where(norm > 0.0, norm, 1.0)
    orthogonal, triangle = np.linalg.qr(design / scale)
    left, singular, directions = np.linalg.svd(triangle)
    known = known_of(singular, directions, scale)
    rank = known.spread.shape[1]
    return Factored(orthogonal @ left[:, :rank], singular[:rank], directions[:rank], scale, known)


def solve_imu(readings: ImuReadings, about: np.ndarray | None = None, *, settled: float = _SETTLED) -> ImuEstimate:
    """Parameters of an IMU and its installation from its rows, with minimal norm in unobservable directions.

    `about`: approximate parameters in the engine's coordinates, the point of linearisation. `settled`: the share of its
    standard deviation by which no parameter changes at the last step. Errors: `ValueError` where no
    row is used, or one is not finite.
    """
    used = np.asarray(readings.segments.used)
    if not used.any():
        raise ValueError("no reading is left between two usable rows")
    if not np.isfinite(readings.observed[used]).all():
        raise ValueError("a reading that is used is not finite")
    estimate = _solved(readings, used, about, settled)
    for number in range(_LINEARISED + 1 if about is not None else 0):
        at = estimate.parameters
        change = _in_deviations(estimate.known, at - about)
        # Where channels see errors of angles by their own, the noise is that of the estimate, too.
        weighed = readings.free or not any(readings.sees_angles(at)) or change <= _WEIGHED
        if weighed and estimate.curved < _CURVED:
            break
        if number == _LINEARISED:
            return estimate._replace(moved=max(estimate.moved, change))
        estimate, about = _solved(readings, used, at, _SETTLED), at
    return estimate


def _in_deviations(known: Posterior, change: np.ndarray) -> float:
    """The largest change of an observable parameter, in standard deviations."""
    deviation = known.deviations(np.eye(len(change)))
    counted = np.isfinite(deviation) & (deviation > 0.0)
    return float(np.max(np.abs(change[counted]) / deviation[counted], initial=0.0))


def _solved(readings: ImuReadings, used: np.ndarray, about: np.ndarray | None, settled: float) -> ImuEstimate:
    """The estimate with the noise and derivatives at `about`, iterated from there."""
    model = readings.model
    steps, columns = readings.linear(about)
    white, prior = readings.whitener(steps), model.prior_rows()
    jacobian = white(columns)
    design = np.concatenate([jacobian, prior])
    of = factored(design)

    def left_over(beta: np.ndarray) -> tuple[np.ndarray, float]:
        rest = white(readings.left(beta)[:, None])[:, 0]
        return rest, float(rest @ rest + np.sum((prior @ beta) ** 2))

    beta, moved, rounds, curved = np.zeros(model.size) if about is None else about.copy(), np.inf, 0, 0.0
    rest, squares = left_over(beta)
    first, begun = rest, beta
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
        moved = _in_deviations(of.known, step)
        curved = float(np.linalg.norm(rest - first + jacobian @ (beta - begun)))
        rounds += 1
    degrees = len(design) - len(of.singular)
    leverage = np.sum(of.basis[: len(jacobian)] ** 2, axis=1)
    if readings.free:
        lost = absorbed(steps, readings.angle_states)[readings.by_steps(used)]
        degrees -= round(float(np.sum(lost)))
        leverage = leverage + lost
    linear = Whitened(jacobian, rest + jacobian @ beta, prior)
    channel = readings.segments.row_channel[used]
    return ImuEstimate(
        beta, of.known, rest, squares, degrees, linear, used, channel, leverage, moved, rounds, curved
    )  # fmt: skip


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
    motion, rows = readings.done.motion, readings.done.rows
    at, row = readings.segments, readings.row
    states = by_reading(steps, readings.left(parameters)[:, None])[0][:, readings.angle_states, 0]
    result = np.full((len(readings.log.time_s), motion.geometry.axis_count), np.nan)
    piece = np.where(row >= 0, at.first[at.row_segment[np.maximum(row, 0)]], -1)
    for axis in range(motion.geometry.axis_count):
        moves = np.flatnonzero(motion.axis == axis)
        for first, end in zip(np.append(0, moves + 1), np.append(moves, len(motion.axis)), strict=True):
            known = np.flatnonzero((piece >= first) & (piece < end))
            if len(known):
                result[rows[first] : rows[end] + 1, axis] = states[known[-1], axis]
    return result
