"""Calibration without a table: a unit held still in many positions and turned by hand, with gravity as reference.

Two least-squares problems, one after the other (Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for
IMU calibration without external equipments", ICRA 2014), here with the covariance of every row:

    |f| = g             over each standstill           accelerometers: bias β, lower triangular E       9
    Cᵀ u = u'           from each to the next          gyros: bias b, whole E, sensitivity G to f      21
    rate = b + G f + e  over each standstill           the same b and G; e: the Earth's horizontal rate, 2

    force = (I + E) f + β,    rate = (I + E) ω + b + G f;    u: f/g;    C: attitude from the gyros, body to the start

The accelerometers define the frame: x along accelerometer x, y in the plane of x and y. Differences of neighbouring
parts of standstills give the noise. The covariance of the second problem's rows includes the noise of the two
directions u and the accelerometers' coefficients; the direction of the Earth's horizontal rate is carried from turn to
turn, and its vertical rate is part of G. Where the residuals of rows exceed their noise, the rows count with the
standard deviation that explains them (Birge), in every pass.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.standstill import find_standstills

# Priors, far wider than the posterior: of scale factors and misalignments, rad/s, rad/s, rad/s/(m/s²) (2000 deg/h/g).
_RELATIVE, _RATE_BIAS, _EARTH, _SENSITIVITY = 0.1, 0.1, 7.292115e-5, 1e-3
_BLOCK_S = 0.5
LOWER = tuple((j, l) for j in range(3) for l in range(j + 1))
# A direction that keeps this share of its prior variance is unobservable, and so are parameters with this share in it.
_KEPT, _TAKES_PART = 0.5, 0.05
_LEAST = 9
# Errors of gravity's norm (a share), and of its direction after a turn (rad), that no unit in SI has.
_OTHER_UNIT, _STRANGE = 0.4, 0.3
# Fits, each with the weights by the one before.
_PASSES = 4
KINDS_OF_ROWS = ("accelerometers: norm of gravity", "gyros: turns of gravity", "gyros: rates at rest")


class HandRows(NamedTuple):
    """One unit's usable rows: `time` (n,) s, `rates` (rad/s) and `force` (m/s²) (n, 3), `broken` (n,): whether rows
    before it were lost; `standing` (n,): number of the standstill, −1 between."""

    time: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    broken: np.ndarray
    standing: np.ndarray


class Positions(NamedTuple):
    """The standstills: `force`, `rates` `(K, 3)` means, `duration` `(K,)` s, `rows` `(K, 2)` first and last; and the
    white noise `(3,)` of each axis, as variance of a mean over one second."""

    force: np.ndarray
    rates: np.ndarray
    duration: np.ndarray
    rows: np.ndarray
    force_noise: np.ndarray
    rate_noise: np.ndarray


class ByHand(NamedTuple):
    """Parameters `(32,)` with their covariance: β and E of the accelerometers, rows of (E, b, G) by gyro, the Earth's
    horizontal rate (rad/s) in axes of unknown azimuth; `hidden`: the unobservable ones. By kind of rows: `tests` by the
    noise alone, residuals `left`, and the `factors` of their standard deviation, which explain these; `turns`: how many
    were used."""

    positions: Positions
    parameters: np.ndarray
    covariance: np.ndarray
    hidden: np.ndarray
    tests: dict[str, Test]
    left: list[np.ndarray]
    factors: np.ndarray
    turns: int


def find_positions(rates: np.ndarray, force: np.ndarray, sample_interval_s: float) -> np.ndarray:
    """`(n,)`: the standstill's number of each row, −1 between; by both triads, `(n, 3)` each in any unit."""
    output = np.concatenate([rates, force], axis=1)
    output = output - np.median(output, axis=0)
    width = max(round(_BLOCK_S / sample_interval_s), 4)
    square = uniform_filter1d(output**2, width, axis=0) - uniform_filter1d(output, width, axis=0) ** 2
    quiet = np.quantile(np.sqrt(np.maximum(square, 0.0)), 0.1, axis=0)
    quiet = np.maximum(quiet, 1e-6 * np.max(np.abs(output), axis=0) + 1e-300)
    return find_standstills(output / quiet, sample_interval_s, largest_bias=np.inf)


def positions(rows: HandRows) -> Positions:
    """The standstills' means, and the noise in them. Errors: `ValueError` where there are too few."""
    step = float(np.median(np.diff(rows.time)))
    block = max(round(_BLOCK_S / step), 2)
    both = np.concatenate([rows.force, rows.rates], axis=1)
    means, lasting, ends, squares = [], [], [], []
    for k in range(int(rows.standing.max(initial=-1)) + 1):
        here = np.flatnonzero(rows.standing == k)
        if len(here) < 2 * block:
            continue
        parts = both[here[: len(here) // block * block]].reshape(-1, block, 6).mean(axis=1)
        squares.append(0.5 * np.diff(parts, axis=0) ** 2)
        means.append(both[here].mean(axis=0))
        lasting.append(len(here) * step)
        ends.append((here[0], here[-1]))
    if len(means) < _LEAST:
        raise ValueError(
            f"{len(means)} standstills of a second or more were detected, and at least {_LEAST} are needed: "
            "lay the IMU down in some twenty positions, in all directions, for five seconds each"
        )
    mean = np.array(means)
    noise = np.concatenate(squares).mean(axis=0) * block * step
    # A lower limit for a coarsely quantised sensor with constant output.
    noise = np.maximum(noise, 1e-18 * np.ptp(mean, axis=0) ** 2 + 1e-300)
    return Positions(mean[:, :3], mean[:, 3:], np.array(lasting), np.array(ends), noise[:3], noise[3:])


class _Fit(NamedTuple):
    """Parameters `(p,)` with their covariance; χ² by the noise alone; residuals of the tested rows, the `factor` of
    their standard deviation, which explains them, and the covariance of all rows with it."""

    parameters: np.ndarray
    covariance: np.ndarray
    hidden: np.ndarray
    test: Test
    left: np.ndarray
    factor: float
    whole: np.ndarray


def solve_by_hand(rows: HandRows, gravity: float) -> ByHand:
    """Accelerometers by the norm of gravity (m/s²), then gyros by its turns. Errors: `ValueError` that states what the
    record lacks."""
    held = positions(rows)
    size = float(np.median(np.linalg.norm(held.force, axis=1)))
    if abs(size / gravity - 1.0) > _OTHER_UNIT:
        raise ValueError(
            f"at rest the accelerometers show {size:.4g} m/s², and gravity is {gravity:.6g} m/s²: does the column map "
            "state the unit, the scale and the zero of these columns?"
        )

    def norms(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        f, df, inverse = _true_force(p, held.force)
        norm = np.linalg.norm(f, axis=1)
        u = f / norm[:, None]
        variance = (u @ inverse) ** 2 @ held.force_noise / held.duration
        return norm - gravity, np.einsum("ka,kap->kp", u, df), np.diag(variance)

    force = _fit(norms, np.array([_RELATIVE * gravity] * 3 + [_RELATIVE] * 6), len(held.duration))
    turns = _Turns(rows, held, force, gravity)
    rest, gyro = turns.fitted()
    # The attitudes are now accurate enough for the direction of the Earth's horizontal rate.
    turns.level = turns.levels(gyro.parameters)
    rest, gyro = turns.fitted()
    # An error of the accelerometers' coefficients changes the gyros' by minus their gain times its effect on the rows.
    _, slope, known, _ = turns.rows(gyro.parameters)
    gain = np.linalg.solve(gyro.whole[: len(slope), : len(slope)], slope) @ gyro.covariance
    cross = -force.covariance @ known.T @ gain
    fits = force, gyro, rest
    return ByHand(
        held,
        np.concatenate([force.parameters, gyro.parameters]),
        np.block([[force.covariance, cross], [cross.T, gyro.covariance]]),
        np.concatenate([force.hidden, gyro.hidden]),
        {kind: fit.test for kind, fit in zip(KINDS_OF_ROWS, fits, strict=True)},
        [fit.left for fit in fits],
        np.array([fit.factor for fit in fits]),
        len(turns.start),
    )


def _true_force(p: np.ndarray, output: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`f` (K, 3), its derivative (K, 3, 9), and the inverse of I + E."""
    matrix = np.eye(3)
    for value, place in zip(p[3:], LOWER, strict=True):
        matrix[place] += value
    inverse = np.linalg.inv(matrix)
    f = (output - p[:3]) @ inverse.T
    df = [np.broadcast_to(-inverse[:, j], f.shape) for j in range(3)]
    df += [-np.outer(f[:, l], inverse[:, j]) for j, l in LOWER]
    return f, np.stack(df, axis=2), inverse


class _Turns:
    """The second problem: parameters are rows of (E, b, G) by gyro, and the Earth's horizontal rate in the two
    directions `level` (K, 3, 2), body components, zeros where they are not known. The rows between standstills are
    padded with rows of no duration: `step` (M, n), `rates` as recorded and corrected `force` (M, n, 3); `start` (M,):
    the standstill before each."""

    def __init__(self, rows: HandRows, held: Positions, accelerometer: _Fit, gravity: float) -> None:
        self.held, self.accelerometer = held, accelerometer
        force = _true_force(accelerometer.parameters, rows.force)[0]
        every = np.column_stack([np.diff(rows.time, prepend=rows.time[0]), rows.rates, force])
        spans = [slice(int(a) + 1, int(b) + 1) for a, b in zip(held.rows[:-1, 1], held.rows[1:, 0], strict=True)]
        self.start = np.array([k for k, span in enumerate(spans) if not rows.broken[span].any()], int)
        if len(self.start) < _LEAST - 1:
            raise ValueError(
                f"only {len(self.start)} turns between standstills were recorded without a gap; more are needed"
            )
        padded = np.zeros((len(self.start), max(spans[k].stop - spans[k].start for k in self.start), 7))
        for m, k in enumerate(self.start):
            padded[m, : spans[k].stop - spans[k].start] = every[spans[k]]
        self.step, self.rates, self.force = padded[..., 0], padded[..., 1:4], padded[..., 4:]
        self.lasting = self.step.sum(axis=1)
        self.f, self.df, inverse = _true_force(accelerometer.parameters, held.force)
        self.noise = (inverse * held.force_noise) @ inverse.T / held.duration[:, None, None]
        self.u = u = self.f / gravity
        square = np.sum(u**2, axis=1)[:, None, None]
        self.across = (np.eye(3) - u[:, :, None] * u[:, None, :] / square) / gravity
        self.level = np.zeros((len(u), 3, 2))

    def attitudes(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Attitude after each move (M, 3, 3), body to where it started, and its rotation by each parameter (M, 3, 21),
        there.

        A row is the mean rate since the row before: its rotation vector is corrected for coning with the row before (P.
        Savage, "Strapdown inertial navigation integration algorithm design", J. Guidance, Control, and Dynamics 21,
        1998).
        """
        table = p[:21].reshape(3, 7)
        inverse = np.linalg.inv(np.eye(3) + table[:, :3])
        omega = (self.rates - table[:, 3] - self.force @ table[:, 4:].T) @ inverse.T
        turn = omega * self.step[..., None]
        before = np.concatenate([np.zeros_like(turn[:, :1]), turn[:, :-1]], axis=1)
        vector = turn + np.cross(before, turn) / 12.0
        after = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3)
        stride = 1
        while stride < after.shape[1]:  # products of 1, 2, 4, … rows
            after = np.concatenate([after[:, :stride], after[:, :-stride] @ after[:, stride:]], axis=1)
            stride *= 2
        first = np.broadcast_to(np.eye(3), (len(after), 1, 3, 3))
        middle = 0.5 * (after + np.concatenate([first, after[:, :-1]], axis=1))
        signals = np.concatenate([omega, np.ones_like(omega[..., :1]), self.force], axis=2) * self.step[..., None]
        summed = np.einsum("mnac,mnx->macx", middle, signals, optimize=True)
        return after[:, -1], -np.einsum("macx,cj->majx", summed, inverse).reshape(len(after), 3, 21)

    def rows(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The turns' residuals (2M,), their derivatives (2M, 23) and by the accelerometers' coefficients (2M, 9), and
        their covariance by the noise of the directions and by these coefficients."""
        k, after, moves = self.start, self.start + 1, np.arange(len(self.start))
        attitude, by = self.attitudes(p)
        # Two directions perpendicular to the later one.
        basis = np.linalg.svd(self.u[after][:, None, :])[2][:, 1:, :]
        back = basis @ attitude.transpose(0, 2, 1)
        # A rotation φ before the turn adds Cᵀ (u × φ). The Earth's rate there, C(t)ᵀ e, is constant, e.
        every = np.concatenate([by, -self.lasting[:, None, None] * self.level[k]], axis=2)
        slope = (back @ np.cross(self.u[k][:, :, None], every, axis=1)).reshape(-1, 23)
        left = np.einsum("mia,ma->mi", back, self.u[k]) - np.einsum("mia,ma->mi", basis, self.u[after])
        of_means = np.zeros((len(k), 2, len(self.f), 3))
        of_means[moves, :, k] = back @ self.across[k]
        of_means[moves, :, after] = -basis @ self.across[after]
        of_means = of_means.reshape(-1, len(self.f), 3)
        known = np.einsum("ika,kap->ip", of_means, self.df)
        covariance = np.einsum("ika,kab,jkb->ij", of_means, self.noise, of_means, optimize=True)
        covariance += known @ self.accelerometer.covariance @ known.T
        return left.ravel() + slope[:, 21:] @ p[21:], slope, known, covariance

    def fitted(self) -> tuple[_Fit, _Fit]:
        """The fit of the rates at rest alone, and that of all rows. Raises `ValueError` where the turns are not those
        of gravity at all."""
        priors = np.r_[np.tile([_RELATIVE] * 3 + [_RATE_BIAS] + [_SENSITIVITY] * 3, 3), [_EARTH] * 2]
        columns = np.zeros((*self.f.shape, 23))
        for j in range(3):
            columns[:, j, 7 * j + 3] = 1.0
            columns[:, j, 7 * j + 4 : 7 * j + 7] = self.f
        columns[..., 21:] = self.level
        columns, rates = columns.reshape(-1, 23), self.held.rates.ravel()
        white = (self.held.rate_noise / self.held.duration[:, None]).ravel()

        def resting(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            return columns @ p - rates, columns, np.diag(white)

        rest = _fit(resting, priors, len(white))
        # The drift, the changes of the rates at rest beyond noise, acts in every turn, too.
        drift = (rest.factor**2 - 1.0) * np.mean(white)
        own = np.repeat(np.mean(self.held.rate_noise) * self.lasting + drift * self.lasting**2, 2)

        def rows(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            left, slope, _, covariance = self.rows(p)
            whole = np.diag(np.r_[own, white * rest.factor**2])
            whole[: len(own), : len(own)] += covariance
            return np.r_[left, columns @ p - rates], np.concatenate([slope, columns]), whole

        off = self.rows(np.zeros(23))[0].reshape(-1, 2)
        if np.median(np.linalg.norm(off, axis=1)) > _STRANGE:
            raise ValueError(
                "no scale factor of the gyros explains the change of gravity's direction between positions, as "
                "measured by the accelerometers: do both triads have the same axes, with the same signs, and the same "
                "clock, and does the column map state the unit, the scale and the zero of the rates?"
            )
        return rest, _fit(rows, priors, len(own))

    def levels(self, p: np.ndarray) -> np.ndarray:
        """Two fixed horizontal directions in body components at each position (K, 3, 2); zeros after a missing turn."""
        level, turned = np.zeros_like(self.level), self.attitudes(p)[0]
        if self.start[0] == 0:
            level[0] = np.linalg.svd(self.u[0][None])[2][1:].T
        for m, k in enumerate(self.start):
            if m != k:
                break
            carried, up = turned[m].T @ level[k], self.u[k + 1]
            # Remove the vertical part, which is an error of the gyros.
            q, r = np.linalg.qr(carried - np.outer(up, up @ carried) / (up @ up))
            level[k + 1] = q * np.sign(np.diag(r))
        return level


_Rows = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _fit(rows: _Rows, priors: np.ndarray, tested: int) -> _Fit:
    """Least squares of rows with a covariance: `rows(p)` gives residuals (r,), their derivative (r, p), covariance
    (r, r). The standard deviation of the first `tested` rows grows where the residuals exceed the noise."""
    size, p, factor, tests = len(priors), np.zeros(len(priors)), 1.0, list[Test]()
    known, whole, unseen = np.diag(priors**2), np.zeros((0, 0)), np.zeros((size, 0))
    for k in range(_PASSES):
        whole = rows(p)[2]
        whole[:tested, :tested] *= factor**2
        root = np.linalg.cholesky(whole)

        def white(p: np.ndarray, root: np.ndarray = root) -> np.ndarray:
            """Residuals and derivatives `(r + p, 1 + p)` of variance one, the priors' last."""
            both = solve_triangular(root, np.column_stack(rows(p)[:2]), lower=True)
            return np.concatenate([both, np.column_stack([p / priors, np.diag(1.0 / priors)])])

        jacobian: Any = lambda p, of=white: of(p)[:, 1:]  # noqa: E731
        exact: Any = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12}
        fit = least_squares(lambda p, of=white: of(p)[:, 0], p, jac=jacobian, x_scale=priors, **exact)
        p, known = fit.x, np.linalg.inv(fit.jac.T @ fit.jac)
        values, vectors = np.linalg.eigh(known / np.outer(priors, priors))
        unseen = vectors[:, values > _KEPT]
        seen, squares = size - unseen.shape[1], fit.fun[:-size] ** 2
        tests.append(chi_squared_test(float(np.sum(squares)), len(squares) - seen))
        if k and tests[1].passed:
            break
        if k:
            # What the other rows say of the parameters takes no degrees of freedom from these.
            taken = float(np.sum(np.linalg.qr(fit.jac)[0][:tested] ** 2))
            factor = max(1.0, factor * float(np.sqrt(np.sum(squares[:tested]) / max(tested - taken, 1.0))))
    hidden = np.sum(unseen**2, axis=1) > _TAKES_PART
    return _Fit(p, known, hidden, tests[1], rows(p)[0][:tested], factor, whole)
