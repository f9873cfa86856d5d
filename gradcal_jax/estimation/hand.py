"""Calibration without a table: a unit held still in many positions and turned by hand, with gravity as reference.

Two least-squares problems, one after the other (Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for
IMU calibration without external equipments", ICRA 2014), here with the covariance of every row:

    |f| = g             over each standstill           accelerometers: bias β, lower triangular E       9
    Cᵀ u = u'           from each to the next          gyros: bias b, whole E, sensitivity G to f      21
    rate = b + G f + e  over each standstill           the same b and G; e: the Earth's horizontal rate, 2

    force = (I + E) f + β,    rate = (I + E) ω + b + G f;    u: f/g;    C: attitude from the gyros, body to the start

The accelerometers define the frame: x along accelerometer x, y in the plane of x and y. Differences of neighbouring
parts of standstills give the noise. The covariance of the second problem's rows includes the noise of the two
directions u and the accelerometers' coefficients; the direction of the Earth's rate is carried from turn to turn. Where
residuals exceed the noise, a variance is added that explains them (Paule and Mandel, J. Res. NBS 87, 1982).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.linalg import solve_triangular
from scipy.ndimage import uniform_filter1d
from scipy.optimize import OptimizeResult, brentq, least_squares
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


class HandRows(NamedTuple):
    """One unit's rows: `time` (n,) s, `rates` (rad/s) and `force` (m/s²) (n, 3), `usable` (n,): false where the row is
    masked or the one before it is missing; `standing` (n,): number of the standstill, −1 between.
    """

    time: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    usable: np.ndarray
    standing: np.ndarray


class Positions(NamedTuple):
    """The standstills: `force`, `rates` `(K, 3)` means, `duration` `(K,)` s, `rows` `(K, 2)` first and last; and the
    white noise `(3,)` of each axis, as variance of a mean over one second.
    """

    force: np.ndarray
    rates: np.ndarray
    duration: np.ndarray
    rows: np.ndarray
    force_noise: np.ndarray
    rate_noise: np.ndarray


class Fitted(NamedTuple):
    """Parameters `(p,)` with their covariance; `hidden` `(p,)`: the unobservable ones; `test`: χ² by the noise alone;
    `left`: residuals of the tested rows; `taken`: the same rows of an orthonormal basis of the fitted columns;
    `beyond`: added standard deviation.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    hidden: np.ndarray
    test: Test
    left: np.ndarray
    taken: np.ndarray
    beyond: float


class ByHand(NamedTuple):
    """Both triads. `cross` `(9, 21)`: covariance of their parameters; `at_rest`: test of the rates over standstills,
    `unsteady` (rad/s): their changes beyond noise; `turns`: number of turns used; `earth_level` `(2,)`: estimate of the
    Earth's horizontal rate, rad/s, in axes of unknown azimuth.
    """

    positions: Positions
    accelerometer: Fitted
    gyro: Fitted
    cross: np.ndarray
    at_rest: Test
    unsteady: float
    turns: int
    earth_level: np.ndarray


def find_positions(rates: np.ndarray, force: np.ndarray, sample_interval_s: float, usable: np.ndarray) -> np.ndarray:
    """`(n,)`: the standstill's number of each row, −1 between; by both triads, `(n, 3)` each in any unit."""
    output = np.nan_to_num(np.concatenate([rates, force], axis=1))
    output = output - np.median(output[usable], axis=0)
    width = max(round(_BLOCK_S / sample_interval_s), 4)
    mean = uniform_filter1d(output, width, axis=0)
    spread = np.sqrt(np.maximum(uniform_filter1d(output**2, width, axis=0) - mean**2, 0.0))
    quiet = np.quantile(spread[usable], 0.1, axis=0)
    if not (quiet > 0.0).all():
        quiet = np.maximum(quiet, 1e-6 * np.max(np.abs(output), axis=0) + 1e-300)
    return find_standstills(output / quiet, sample_interval_s, largest_bias=np.inf, valid=usable)


def positions(rows: HandRows) -> Positions:
    """The standstills' means, and the noise in them. Errors: `ValueError` where there are too few."""
    step = float(np.median(np.diff(rows.time)))
    block = max(round(_BLOCK_S / step), 2)
    both = np.concatenate([rows.force, rows.rates], axis=1)
    means, lasting, ends, squares = [], [], [], []
    for k in range(int(rows.standing.max(initial=-1)) + 1):
        here = np.flatnonzero(rows.standing == k)
        good = here[rows.usable[here]]
        if len(good) < 2 * block:
            continue
        parts = both[good[: len(good) // block * block]].reshape(-1, block, 6).mean(axis=1)
        squares.append(0.5 * np.diff(parts, axis=0) ** 2)
        means.append(both[good].mean(axis=0))
        lasting.append(len(good) * step)
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


def solve_by_hand(rows: HandRows, gravity: float, earth_up: float = 0.0) -> ByHand:
    """Accelerometers by the norm of gravity (m/s²), then gyros by its turns. `earth_up`: vertical Earth rate, rad/s.

    Errors: `ValueError` that states what the record lacks.
    """
    held = positions(rows)
    accelerometer = _accelerometers(held, gravity)
    return _gyros(held, accelerometer, _moves(rows, held, accelerometer), gravity, earth_up)


def _accelerometers(held: Positions, gravity: float) -> Fitted:
    size = float(np.median(np.linalg.norm(held.force, axis=1)))
    if abs(size / gravity - 1.0) > _OTHER_UNIT:
        raise ValueError(
            f"at rest the accelerometers show {size:.4g} m/s², and gravity is {gravity:.6g} m/s²: does the column map "
            "state the unit, the scale and the zero of these columns?"
        )

    def rows(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        f, df, inverse = _true_force(p, held.force)
        norm = np.linalg.norm(f, axis=1)
        u = f / norm[:, None]
        variance = (u @ inverse) ** 2 @ held.force_noise / held.duration
        return norm - gravity, np.einsum("ka,kap->kp", u, df), np.diag(variance)

    return _fit(rows, np.array([_RELATIVE * gravity] * 3 + [_RELATIVE] * 6), len(held.duration))


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


# --- gyros ------------------------------------------------------------------------------------------------------------


class _Moves(NamedTuple):
    """The rows between standstills, padded with rows of no duration: `step` (M, n), `rates` as recorded and corrected
    `force` (M, n, 3), `start` (M,): the standstill before each.
    """

    step: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    start: np.ndarray


def _moves(rows: HandRows, held: Positions, accelerometer: Fitted) -> _Moves:
    spans = [slice(int(a) + 1, int(b) + 1) for a, b in zip(held.rows[:-1, 1], held.rows[1:, 0], strict=True)]
    start = np.array([k for k, span in enumerate(spans) if rows.usable[span].all()], int)
    if len(start) < _LEAST - 1:
        raise ValueError(f"only {len(start)} turns between standstills were recorded without a gap; more are needed")
    force = _true_force(accelerometer.parameters, rows.force)[0]
    every = np.column_stack([np.diff(rows.time, prepend=rows.time[0]), rows.rates, force])
    padded = np.zeros((len(start), max(spans[k].stop - spans[k].start for k in start), 7))
    for m, k in enumerate(start):
        padded[m, : spans[k].stop - spans[k].start] = every[spans[k]]
    return _Moves(padded[..., 0], padded[..., 1:4], padded[..., 4:], start)


def _turned(p: np.ndarray, moves: _Moves) -> tuple[np.ndarray, np.ndarray]:
    """Attitude after each move (M, 3, 3), body to where it started, and its rotation by each parameter (M, 3, 21),
    there.

    A row is the mean rate since the row before: its rotation vector is corrected for coning with the row before (P.
    Savage, "Strapdown inertial navigation integration algorithm design", J. Guidance, Control, and Dynamics 21, 1998).
    """
    table = p.reshape(3, 7)
    inverse = np.linalg.inv(np.eye(3) + table[:, :3])
    omega = (moves.rates - table[:, 3] - moves.force @ table[:, 4:].T) @ inverse.T
    turn = omega * moves.step[..., None]
    before = np.concatenate([np.zeros_like(turn[:, :1]), turn[:, :-1]], axis=1)
    vector = turn + np.cross(before, turn) / 12.0
    after = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3)
    stride = 1
    while stride < after.shape[1]:  # products of 1, 2, 4, … rows
        after = np.concatenate([after[:, :stride], after[:, :-stride] @ after[:, stride:]], axis=1)
        stride *= 2
    first = np.broadcast_to(np.eye(3), (len(after), 1, 3, 3))
    middle = 0.5 * (after + np.concatenate([first, after[:, :-1]], axis=1))
    signals = np.concatenate([omega, np.ones((*omega.shape[:2], 1)), moves.force], axis=2) * moves.step[..., None]
    summed = np.einsum("mnac,mnx->macx", middle, signals, optimize=True)
    by = -np.einsum("macx,cj->majx", summed, inverse).reshape(len(after), 3, 21)
    return after[:, -1], by


def _gyros(held: Positions, accelerometer: Fitted, moves: _Moves, gravity: float, earth_up: float) -> ByHand:
    f, df, inverse = _true_force(accelerometer.parameters, held.force)
    noise = (inverse * held.force_noise) @ inverse.T / held.duration[:, None, None]
    u = f / gravity
    across = (np.eye(3) - np.einsum("ka,kb->kab", u, u) / np.sum(u**2, axis=1)[:, None, None]) / gravity
    k, after = moves.start, moves.start + 1
    # Two directions perpendicular to the later one.
    basis = np.linalg.svd(u[after][:, None, :])[2][:, 1:, :]
    lasting, size = moves.step.sum(axis=1), 2 * len(k)
    at_rest, level = (held.rates - earth_up * u).ravel(), (held.rate_noise / held.duration[:, None]).ravel()
    columns = np.zeros((3 * len(f), 21))
    for j in range(3):  # parameters are rows of (E, b, G) by gyro
        columns[j::3, 7 * j + 3] = 1.0
        columns[j::3, 7 * j + 4 : 7 * j + 7] = f
    priors = np.r_[np.tile([_RELATIVE] * 3 + [_RATE_BIAS] + [_SENSITIVITY] * 3, 3), [_EARTH] * 2]

    def turns(p: np.ndarray, level_of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The turns' residuals (2M,), their derivatives (2M, 23) and by the accelerometers' coefficients (2M, 9), and
        their covariance by the noise of the directions and by these coefficients."""
        attitude, by = _turned(p[:21], moves)
        back = basis @ attitude.transpose(0, 2, 1)
        # A rotation φ before the turn adds Cᵀ (u × φ). The Earth's rate there, C(t)ᵀ e, is constant, e.
        earth = -lasting[:, None, None] * level_of[k]
        slope = back @ np.cross(u[k][:, None, :], np.concatenate([by, earth], axis=2).transpose(0, 2, 1)).transpose(
            0, 2, 1
        )
        slope = slope.reshape(size, 23)
        left = np.einsum("mia,ma->mi", back, u[k]) - np.einsum("mia,ma->mi", basis, u[after])
        of_means = np.zeros((len(k), 2, len(f), 3))
        of_means[np.arange(len(k)), :, k] = back @ across[k]
        of_means[np.arange(len(k)), :, after] = -basis @ across[after]
        of_means = of_means.reshape(size, len(f), 3)
        known = np.einsum("ika,kap->ip", of_means, df)
        covariance = np.einsum("ika,kab,jkb->ij", of_means, noise, of_means, optimize=True)
        covariance += known @ accelerometer.covariance @ known.T
        return left.ravel() + slope[:, 21:] @ p[21:], slope, known, covariance

    def fit(level_of: np.ndarray) -> tuple[Fitted, Fitted, np.ndarray]:
        """The rates at rest alone, and all together; and the turns' own variance."""
        resting = np.concatenate([columns, level_of.reshape(-1, 2)], axis=1)
        seen = np.r_[columns.any(axis=0), True, True]
        alone, by_white = resting[:, seen], np.diag(level)
        rest = _fit(lambda p: (alone @ p - at_rest, alone, by_white), priors[seen], len(level))
        # The drift, the changes of the rates at rest beyond noise, acts in every turn, too.
        own = np.repeat(np.mean(held.rate_noise) * lasting + rest.beyond**2 * lasting**2, 2)

        def rows(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            left, slope, _, covariance = turns(p, level_of)
            whole = np.diag(np.r_[own, level + rest.beyond**2])
            whole[:size, :size] += covariance
            return np.r_[left, resting @ p - at_rest], np.concatenate([slope, resting]), whole

        return rest, _fit(rows, priors, size), own

    level_of = np.zeros((len(f), 3, 2))
    off = np.linalg.norm(turns(np.zeros(23), level_of)[0].reshape(-1, 2), axis=1)
    if np.median(off) > _STRANGE:
        raise ValueError(
            "no scale factor of the gyros explains the change of gravity's direction between positions, as measured by "
            "the accelerometers: do both triads have the same axes, with the same signs, and the same clock, and does "
            "the column map state the unit, the scale and the zero of the rates?"
        )
    _, gyro, _ = fit(level_of)
    # The attitudes are now accurate enough for the direction of the Earth's horizontal rate.
    level_of = _level(_turned(gyro.parameters[:21], moves)[0], k, u)
    rest, gyro, own = fit(level_of)
    _, slope, known, covariance = turns(gyro.parameters, level_of)
    # An error of the accelerometers' coefficients changes the gyros' by minus their gain times its effect on the rows.
    whole = covariance + np.diag(own + gyro.beyond**2)
    cross = -accelerometer.covariance @ known.T @ np.linalg.solve(whole, slope) @ gyro.covariance
    earth = gyro.parameters[21:]
    gyro = gyro._replace(parameters=gyro.parameters[:21], covariance=gyro.covariance[:21, :21], hidden=gyro.hidden[:21])
    return ByHand(held, accelerometer, gyro, cross[:, :21], rest.test, rest.beyond, len(k), earth)


def _level(turned: np.ndarray, start: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Two fixed horizontal directions in body components at each position (K, 3, 2); zeros after a missing turn."""
    level = np.zeros((len(u), 3, 2))
    level[0] = np.linalg.svd(u[0][None])[2][1:].T
    for m, k in enumerate(start):
        if m != k:
            break
        carried = turned[m].T @ level[k]
        # Remove the vertical part, which is an error of the gyros.
        q, r = np.linalg.qr(carried - np.outer(u[k + 1], u[k + 1] @ carried) / (u[k + 1] @ u[k + 1]))
        level[k + 1] = q * np.sign(np.diag(r))
    return level if start[0] == 0 else np.zeros_like(level)


# --- least squares ----------------------------------------------------------------------------------------------------


_Rows = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _fit(rows: _Rows, priors: np.ndarray, tested: int) -> Fitted:
    """Least squares of rows with a covariance: `rows(p)` gives residuals (r,), their derivative (r, p), covariance
    (r, r); `tested`: the number of the first rows, to which a variance is added where residuals exceed the noise.
    """
    size, p = len(priors), np.zeros(len(priors))
    added = np.diag(np.arange(len(rows(p)[0])) < tested).astype(float)

    def white(p: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Residuals and derivatives `(r + p, 1 + p)` of variance one, the priors' last."""
        left, by, _ = rows(p)
        both = solve_triangular(np.linalg.cholesky(covariance), np.column_stack([left, by]), lower=True)
        return np.concatenate([both, np.column_stack([p / priors, np.diag(1.0 / priors)])])

    def solved(start: np.ndarray, beyond: float) -> OptimizeResult:
        """The optimum with the weights at `start`."""
        covariance = rows(start)[2] + added * beyond**2
        jacobian: Any = lambda p: white(p, covariance)[:, 1:]  # noqa: E731
        exact: Any = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12}
        return least_squares(lambda p: white(p, covariance)[:, 0], start, jac=jacobian, x_scale=priors, **exact)

    def known_of(fit: OptimizeResult) -> tuple[np.ndarray, np.ndarray]:
        """Covariance, and the unobservable directions in units of the priors."""
        known = np.linalg.inv(fit.jac.T @ fit.jac)
        values, vectors = np.linalg.eigh(known / np.outer(priors, priors))
        return known, vectors[:, values > _KEPT]

    fit, beyond = solved(solved(p, 0.0).x, 0.0), 0.0
    free = len(added) - (size - known_of(fit)[1].shape[1])
    test = chi_squared_test(float(np.sum(fit.fun[:-size] ** 2)), free)

    def excess(log_std: float) -> float:
        """χ² of the best fit with more variance, over its expectation, less one."""
        of = white(fit.x, rows(fit.x)[2] + added * np.exp(2.0 * log_std))
        rest = of[:, 0] - of[:, 1:] @ np.linalg.lstsq(of[:, 1:], of[:, 0], rcond=None)[0]
        return float(rest @ rest) / max(free, 1) - 1.0

    level = 0.5 * float(np.log(np.median(np.diag(rows(fit.x)[2])[:tested])))
    low, high = level - 12.0, level + 25.0
    for _ in range(0 if test.passed else 3):
        explained = excess(low) <= 0.0 or excess(high) >= 0.0
        beyond = 0.0 if explained else float(np.exp(cast(float, brentq(excess, low, high, xtol=1e-6))))
        fit = solved(fit.x, beyond)
    known, unseen = known_of(fit)
    hidden = np.sum(unseen**2, axis=1) > _TAKES_PART
    taken = np.linalg.qr(fit.jac)[0][:tested]
    return Fitted(fit.x, known, hidden, test, rows(fit.x)[0][:tested], taken, beyond)
