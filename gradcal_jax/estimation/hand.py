"""Calibration without a table: a unit held still in many positions and turned by hand, with gravity as reference.

Two least-squares problems, one after the other (Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for
IMU calibration without external equipments", ICRA 2014), here with the covariance of every row:

    |f| = g             over each standstill           accelerometers: bias β, lower triangular E       9
    Cᵀ u = u'           from each to the next          gyros: bias b, whole E, sensitivity G to f      21
    rate = b + G f + e  over each standstill           the same b and G; e: the Earth's horizontal rate, 2

    output = centre + gain · ((I + E) f + β)           centre, gain: of the sphere of the positions, or 0, 1
    output = centre + gain · ((I + E) ω + b + G f)     u: f/|f|; C: attitude from the gyros, body to where it started

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
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.standstill import find_standstills

# Priors of a unit's errors after scaling: 10 %, 100 mrad, 100 mg, far wider than the posterior.
_RELATIVE = 0.1
_RATE_BIAS = 0.1  # rad/s about the mean of the first standstill
_EARTH = 7.292115e-5  # rad/s
_SENSITIVITY = 1e-3  # rad/s/(m/s²), 2000 deg/h/g
_BLOCK_S = 0.5
LOWER = tuple((j, l) for j in range(3) for l in range(j + 1))
# A direction that keeps this share of its prior variance is unobservable, and so are parameters with this share in it.
_KEPT, _TAKES_PART = 0.5, 0.05
_LEAST = 9
# Errors of turns, rad, above which the rates are not in rad/s.
_STRANGE = 0.1


class HandRows(NamedTuple):
    """One unit's rows: `time` (n,) s, `rates` and `force` (n, 3) in any unit, `usable` (n,): false where the row is
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
    """Parameters `(p,)` with their covariance, in fractions of `gain` about `centre`; `hidden` `(p,)`: the
    unobservable ones; `test`: χ² by the noise alone; `left`: residuals of the tested rows; `taken`: the same rows of an
    orthonormal basis of the fitted columns; `beyond`: added standard deviation.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    hidden: np.ndarray
    centre: np.ndarray
    gain: float
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
    standstills, squares = [], []
    for k in range(int(rows.standing.max(initial=-1)) + 1):
        here = np.flatnonzero(rows.standing == k)
        good = here[rows.usable[here]]
        if len(good) < 2 * block:
            continue
        both = np.concatenate([rows.force[good], rows.rates[good]], axis=1)
        parts = both[: len(good) // block * block].reshape(-1, block, 6).mean(axis=1)
        squares.append(0.5 * np.diff(parts, axis=0) ** 2)
        standstills.append((both.mean(axis=0), len(good) * step, here[0], here[-1]))
    if len(standstills) < _LEAST:
        raise ValueError(
            f"{len(standstills)} standstills of a second or more were detected, and at least {_LEAST} are needed: "
            "lay the IMU down in some twenty positions, in all directions, for five seconds each"
        )
    means = np.array([f[0] for f in standstills])
    noise = np.concatenate(squares).mean(axis=0) * block * step
    # A lower limit for a coarsely quantised sensor with constant output.
    noise = np.maximum(noise, 1e-18 * np.ptp(means, axis=0) ** 2 + 1e-300)
    ends = np.array([[f[2], f[3]] for f in standstills])
    return Positions(means[:, :3], means[:, 3:], np.array([f[1] for f in standstills]), ends, noise[:3], noise[3:])


def solve_by_hand(rows: HandRows, gravity: float, earth_up: float = 0.0) -> ByHand:
    """Accelerometers by the norm of gravity (m/s²), then gyros by its turns. `earth_up`: vertical Earth rate, rad/s.

    Errors: `ValueError` that states what the record lacks.
    """
    held = positions(rows)
    accelerometer = _accelerometers(held, gravity)
    # Corrected means (K, 3), their derivatives by the coefficients (K, 3, 9), their noise's covariance (K, 3, 3).
    f, df, inverse = _true_force(accelerometer.parameters, (held.force - accelerometer.centre) / accelerometer.gain)
    noise = (inverse * (held.force_noise / accelerometer.gain**2)) @ inverse.T / held.duration[:, None, None]
    moves = _moves(rows, held, accelerometer)
    return _gyros(held, accelerometer, f, df, noise, moves, gravity, earth_up)


# --- accelerometers ---------------------------------------------------------------------------------------------------


def _accelerometers(held: Positions, gravity: float) -> Fitted:
    centre, gain = np.zeros(3), 1.0
    if np.max(np.abs(np.linalg.norm(held.force, axis=1) / gravity - 1.0)) > _RELATIVE:
        middle, size = held.force.mean(axis=0), float(np.std(held.force))
        x = (held.force - middle) / size
        table = np.concatenate([2.0 * x, np.ones((len(x), 1))], axis=1)
        solution, _, _, singular = np.linalg.lstsq(table, np.sum(x**2, axis=1), rcond=None)
        if singular[-1] < 1e-2 * singular[0]:
            raise ValueError(
                "the forces are not in m/s², and the positions are too close to one plane to determine zero and "
                "scale: hold the IMU in all directions, or give scale and zero in the column map"
            )
        radius = float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
        centre, gain = middle + size * solution[:3], size * radius / gravity
    output, noise = (held.force - centre) / gain, held.force_noise / gain**2

    def rows(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        f, df, inverse = _true_force(p, output)
        size = np.linalg.norm(f, axis=1)
        u = f / size[:, None]
        variance = (u @ inverse) ** 2 @ noise / held.duration
        return size - gravity, np.einsum("ka,kap->kp", u, df), np.diag(variance)

    priors = np.array([_RELATIVE * gravity] * 3 + [_RELATIVE] * 6)
    return _fit(rows, priors, centre, gain, slice(None))


def _true_force(p: np.ndarray, output: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`f` (K, 3), its derivative (K, 3, 9), and the inverse of I + E."""
    matrix = np.eye(3)
    for value, (j, l) in zip(p[3:], LOWER, strict=True):
        matrix[j, l] += value
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
    spans = [(int(a) + 1, int(b) + 1) for a, b in zip(held.rows[:-1, 1], held.rows[1:, 0], strict=True)]
    start = np.array([k for k, (a, b) in enumerate(spans) if rows.usable[a:b].all()], int)
    if len(start) < _LEAST - 1:
        raise ValueError(f"only {len(start)} turns between standstills were recorded without a gap; more are needed")
    longest = max(spans[k][1] - spans[k][0] for k in start)
    step, rates, force = (np.zeros((len(start), longest, *tail)) for tail in ((), (3,), (3,)))
    dt = np.diff(rows.time, prepend=rows.time[0])
    for m, k in enumerate(start):
        here = slice(*spans[k])
        count = spans[k][1] - spans[k][0]
        output = (rows.force[here] - accelerometer.centre) / accelerometer.gain
        step[m, :count], rates[m, :count] = dt[here], rows.rates[here]
        force[m, :count] = _true_force(accelerometer.parameters, output)[0]
    return _Moves(step, rates, force, start)


def _attitude(p: np.ndarray, moves: _Moves) -> tuple[np.ndarray, np.ndarray]:
    """Attitude after each row of each move (M, n, 3, 3), body to where it started; and the true rates (M, n, 3).

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
    return after, omega


def _turned(p: np.ndarray, moves: _Moves) -> tuple[np.ndarray, np.ndarray]:
    """Attitude after each move (M, 3, 3), and its rotation by each parameter (M, 3, 21), where the move started."""
    after, omega = _attitude(p, moves)
    inverse = np.linalg.inv(np.eye(3) + p.reshape(3, 7)[:, :3])
    first = np.broadcast_to(np.eye(3), (len(after), 1, 3, 3))
    middle = 0.5 * (after + np.concatenate([first, after[:, :-1]], axis=1))
    signals = np.concatenate([omega, np.ones((*omega.shape[:2], 1)), moves.force], axis=2) * moves.step[..., None]
    summed = np.einsum("mnac,mnx->macx", middle, signals, optimize=True)
    by = -np.einsum("macx,cj->majx", summed, inverse).reshape(len(after), 3, 21)
    return after[:, -1], by


def _gyros(
    held: Positions,
    accelerometer: Fitted,
    f: np.ndarray,
    df: np.ndarray,
    noise: np.ndarray,
    moves: _Moves,
    gravity: float,
    earth_up: float,
) -> ByHand:
    u = f / gravity
    across = np.eye(3) - np.einsum("ka,kb->kab", u, u) / np.sum(u**2, axis=1)[:, None, None]
    du = across / gravity  # by f
    k, after = moves.start, moves.start + 1
    # Two directions perpendicular to the later one.
    basis = np.linalg.svd(u[after][:, None, :])[2][:, 1:, :]
    centre, gain = _rate_scale(held, moves, u)
    moves = moves._replace(rates=(moves.rates - centre) / gain)
    at_rest, density = (held.rates - centre) / gain - earth_up * u, held.rate_noise / gain**2
    lasting, size = moves.step.sum(axis=1), 2 * len(k)
    columns = np.zeros((3 * len(f), 21))
    for j in range(3):  # parameters are rows of (E, b, G) by gyro
        columns[j::3, 7 * j + 3] = 1.0
        columns[j::3, 7 * j + 4 : 7 * j + 7] = f
    unmoved = columns.any(axis=0)

    priors = np.r_[np.tile([_RELATIVE] * 3 + [_RATE_BIAS] + [_SENSITIVITY] * 3, 3), [_EARTH] * 2]

    def turns(p: np.ndarray, level_of: np.ndarray) -> tuple[np.ndarray, ...]:
        attitude, by = _turned(p[:21], moves)
        turned = np.einsum("mba,mb->ma", attitude, u[k])
        left = np.einsum("mia,ma->mi", basis, turned - u[after])
        # A rotation φ before the turn adds Cᵀ (u × φ).
        crossed = np.cross(u[k][:, None, :], by.transpose(0, 2, 1))  # (M, 21, 3)
        slope = np.einsum("mia,mba,mpb->mip", basis, attitude, crossed, optimize=True)
        to_first = np.einsum("mia,mba,mbc->mic", basis, attitude, du[k], optimize=True)
        to_second = -basis @ du[after]
        # The Earth's rate C(t)ᵀ e, transformed to the body frame at the begin of the turn, is constant, e.
        earth = np.cross(u[k][:, None, :], -lasting[:, None, None] * level_of[k].transpose(0, 2, 1))
        by_earth = np.einsum("mia,mba,mpb->mip", basis, attitude, earth, optimize=True).reshape(size, 2)
        left = left.ravel() + by_earth @ p[21:]
        return left, np.concatenate([slope.reshape(size, 21), by_earth], axis=1), to_first, to_second

    def by_accelerometers(to_first: np.ndarray, to_second: np.ndarray) -> np.ndarray:
        return (to_first @ df[k] + to_second @ df[after]).reshape(size, 9)

    def covariance_of(to_first: np.ndarray, to_second: np.ndarray) -> np.ndarray:
        """Covariance of the turns' rows, from the noise of the directions and the accelerometers' coefficients."""
        of_means = np.zeros((size, len(f), 3))
        for m in range(len(k)):
            of_means[2 * m : 2 * m + 2, k[m]], of_means[2 * m : 2 * m + 2, after[m]] = to_first[m], to_second[m]
        known = by_accelerometers(to_first, to_second)
        by_noise = np.einsum("ika,kab,jkb->ij", of_means, noise, of_means, optimize=True)
        return by_noise + known @ accelerometer.covariance @ known.T

    def fit(level_of: np.ndarray) -> tuple[Fitted, Fitted, np.ndarray]:
        """The rates at rest alone, and all together, with the turns' own variance."""
        resting = np.concatenate([columns, level_of.reshape(-1, 2)], axis=1)
        level = np.concatenate([density / t for t in held.duration])
        seen = np.r_[unmoved, True, True]
        alone, by_white = resting[:, seen], np.diag(level)
        rest = _fit(lambda p: (alone @ p - at_rest.ravel(), alone, by_white), priors[seen], centre, gain, slice(None))
        # The drift, the changes of the rates at rest beyond noise, acts in every turn, too.
        own = np.repeat(np.mean(density) * lasting + rest.beyond**2 * lasting**2, 2)

        def rows(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            left, slope, to_first, to_second = turns(p, level_of)
            whole = np.diag(np.r_[own, level + rest.beyond**2])
            whole[:size, :size] += covariance_of(to_first, to_second)
            both = np.concatenate([left, resting @ p - at_rest.ravel()])
            return both, np.concatenate([slope, resting]), whole

        return rest, _fit(rows, priors, centre, gain, slice(0, size)), own

    level_of = np.zeros((len(f), 3, 2))
    _, gyro, _ = fit(level_of)
    # The attitudes are now accurate enough for the direction of the Earth's horizontal rate.
    level_of = _level(_turned(gyro.parameters[:21], moves)[0], k, u)
    rest, gyro, own = fit(level_of)
    _, slope, to_first, to_second = turns(gyro.parameters, level_of)
    whole = covariance_of(to_first, to_second) + np.diag(own + gyro.beyond**2)
    known = by_accelerometers(to_first, to_second)
    # An error of the accelerometers' coefficients changes the gyros' by minus their gain times its effect on the rows.
    cross = -accelerometer.covariance @ known.T @ np.linalg.solve(whole, slope) @ gyro.covariance
    own_fit = gyro._replace(
        parameters=gyro.parameters[:21], covariance=gyro.covariance[:21, :21], hidden=gyro.hidden[:21]
    )
    earth = gyro.parameters[21:]
    return ByHand(held, accelerometer, own_fit, cross[:, :21], rest.test, rest.beyond, len(k), earth)


def _level(turned: np.ndarray, start: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Two fixed horizontal directions in body components at each position (K, 3, 2); zeros after a missing turn."""
    level = np.zeros((len(u), 3, 2))
    if start[0] != 0:
        return level
    level[0] = np.linalg.svd(u[0][None])[2][1:].T
    for m, k in enumerate(start):
        if not np.array_equal(start[: m + 1], np.arange(m + 1)):
            break
        carried = turned[m].T @ level[k]
        # Remove the vertical part, which is an error of the gyros.
        q, r = np.linalg.qr(carried - np.outer(u[k + 1], u[k + 1] @ carried) / (u[k + 1] @ u[k + 1]))
        level[k + 1] = q * np.sign(np.diag(r))
    return level


def _rate_scale(held: Positions, moves: _Moves, u: np.ndarray) -> tuple[np.ndarray, float]:
    """Output of the gyros at rest and for one rad/s; the latter is 1 where it rotates gravity correctly."""
    longest = int(np.argmax(held.duration))
    centre = held.rates[longest]

    def off(gain: float) -> float:
        scaled = moves._replace(rates=(moves.rates - centre) / gain)
        after, _ = _attitude(np.zeros(21), scaled)
        left = np.einsum("mba,mb->ma", after[:, -1], u[moves.start]) - u[moves.start + 1]
        return float(np.sqrt(np.median(np.sum(left**2, axis=1))))

    if off(1.0) < _STRANGE:
        return np.zeros(3), 1.0
    # A turn is at least as long as the angle between the positions, which bounds the scale from above.
    way = np.sum(np.linalg.norm(moves.rates - centre, axis=2) * moves.step, axis=1)
    angle = np.arccos(np.clip(np.sum(u[moves.start] * u[moves.start + 1], axis=1), -1.0, 1.0))
    far = angle > 0.3
    if not far.any() or not (way[far] > 0.0).all():
        raise ValueError("the IMU was not turned far enough between standstills to determine the gyros' scale factor")
    gains = np.quantile(way[far] / angle[far], 0.1) * 1.025 ** np.arange(8, -48, -1)
    values = [off(float(gain)) for gain in gains]
    best = int(np.argmin(values))
    if values[best] > 3.0 * _STRANGE:
        raise ValueError(
            "no scale factor of the gyros explains the change of gravity's direction between positions, as measured by "
            "the accelerometers: do both triads have the same axes, with the same signs, and the same clock?"
        )
    return centre, float(gains[best])


# --- least squares ----------------------------------------------------------------------------------------------------


def _fit(
    rows: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
    priors: np.ndarray,
    centre: np.ndarray,
    gain: float,
    tested: slice,
) -> Fitted:
    """Least squares of rows with a covariance: `rows(p)` gives residuals (r,), their derivative (r, p), covariance
    (r, r); `tested`: the rows to which a variance is added where the residuals exceed the noise.
    """
    added = np.zeros(len(rows(np.zeros(len(priors)))[0]))
    added[tested] = 1.0

    def best(start: np.ndarray, beyond: float) -> np.ndarray:
        """The optimum with the weights at `start`."""
        root = np.linalg.cholesky(rows(start)[2] + np.diag(added * beyond**2))

        def white(p: np.ndarray) -> np.ndarray:
            return np.concatenate([solve_triangular(root, rows(p)[0], lower=True), p / priors])

        def slope(p: np.ndarray) -> np.ndarray:
            return np.concatenate([solve_triangular(root, rows(p)[1], lower=True), np.diag(1.0 / priors)])

        jacobian: Any = slope
        return least_squares(white, start, jac=jacobian, x_scale=priors, xtol=1e-12, ftol=1e-12, gtol=1e-12).x

    def known_of(p: np.ndarray, beyond: float) -> tuple[np.ndarray, np.ndarray]:
        """Covariance, and the unobservable directions in units of the priors."""
        white = whitened(p, beyond)
        known = np.linalg.inv(white.T @ white + np.diag(priors**-2.0))
        values, vectors = np.linalg.eigh(known / np.outer(priors, priors))
        return known, vectors[:, values > _KEPT]

    def whitened(p: np.ndarray, beyond: float) -> np.ndarray:
        _, by, covariance = rows(p)
        return solve_triangular(np.linalg.cholesky(covariance + np.diag(added * beyond**2)), by, lower=True)

    p = best(best(np.zeros(len(priors)), 0.0), 0.0)
    left, _, covariance = rows(p)
    free = len(left) - (len(p) - known_of(p, 0.0)[1].shape[1])
    first = np.linalg.solve(np.linalg.cholesky(covariance), left)
    test, beyond = chi_squared_test(float(first @ first), free), 0.0
    for _ in range(0 if test.passed else 3):
        beyond = _beyond(*rows(p), added, p / priors, priors, free)
        p = best(p, beyond)
    known, unseen = known_of(p, beyond)
    hidden = np.sum(unseen**2, axis=1) > _TAKES_PART
    taken = np.linalg.qr(np.concatenate([whitened(p, beyond), np.diag(1.0 / priors)]))[0][: len(left)]
    return Fitted(p, known, hidden, centre, gain, test, rows(p)[0][tested], taken[tested], beyond)


def _beyond(
    left: np.ndarray,
    by: np.ndarray,
    covariance: np.ndarray,
    added: np.ndarray,
    from_prior: np.ndarray,
    priors: np.ndarray,
    free: int,
) -> float:
    """The added standard deviation of these rows for which χ² of the best fit has its expected value. `from_prior`: the
    parameters about which all is linear, over the `priors`."""

    def excess(log_std: float) -> float:
        root = np.linalg.cholesky(covariance + np.diag(added * np.exp(2.0 * log_std)))
        table = np.concatenate([solve_triangular(root, by, lower=True), np.diag(1.0 / priors)])
        known = np.concatenate([solve_triangular(root, left, lower=True), from_prior])
        after = known - table @ np.linalg.lstsq(table, known, rcond=None)[0]
        return float(after @ after) / max(free, 1) - 1.0

    level = 0.5 * float(np.log(np.median(np.diag(covariance)[added > 0.0])))
    low, high = level - 12.0, level + 25.0
    if excess(low) <= 0.0 or excess(high) >= 0.0:
        return 0.0
    return float(np.exp(cast(float, brentq(excess, low, high, xtol=1e-6))))
