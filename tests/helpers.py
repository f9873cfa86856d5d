"""The zoo: scenes with every motion, noise and reference, and slow roads to their covariance that share nothing with
the engine but the scene's numbers.

A `Scene` is plain numbers (SI, °C). `core` makes the engine's plan and model of it. `reference` walks through the scene
by itself: rates from the shapes' textbook formulas, temperatures from the lag's own solution, regressors and the
covariance of all readings by composite Gauss–Legendre integration of the processes' *kernels* (no recursion, no state).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import BSpline as ScipyBSpline
from scipy.optimize import brentq

from gradcal_jax import model as models
from gradcal_jax import motion as trajectory
from gradcal_jax.information import NoiseSteps, Posterior, imu_system, posterior
from gradcal_jax.information.plan_information import imu_information
from gradcal_jax.model import (
    SCALE_FACTOR,
    AxisHarmonics,
    BodyNodes,
    BSpline,
    Channel,
    EncoderNoise,
    GradientOfBias,
    ImuModel,
    Polynomial,
    make_map,
)
from gradcal_jax.motion import Geometry, Schedule, TableMotion

DEG = np.pi / 180.0
DEG_PER_H = DEG / 3600.0
Extended = np.longdouble


@dataclass(frozen=True)
class Act:
    """A move in plain numbers: a rest (`shape="rest"`) or a turn; `every` reads on the way."""

    shape: str
    duration: float
    peak: float = 0.0
    ramp: float = 0.0
    unevenness: float = 0.0
    every: float | None = None


@dataclass(frozen=True)
class Noise:
    """One process: "drift" (σ, τ), "walk" (K), "scale" (σ, τ), "both" (σ, τ with two gains), "constant" (σ, gains)."""

    kind: str
    size: float
    tau: float = np.inf
    bias_gain: float = 1.0
    rate_gain: float = 0.0


@dataclass(frozen=True)
class Scene:
    """Everything that a gradient plan's covariance depends on."""

    start: float
    stretches: tuple[tuple[float, float], ...]
    moves: tuple[Act, ...]
    after: tuple[Act, ...] = ()
    used: tuple[tuple[int, int], ...] | None = None
    read_every: float | None = None
    lag: float | None = None
    arw: float = 0.1 * DEG / 60.0
    noises: tuple[Noise, ...] = ()
    reading_noise: float = 0.05 * DEG
    offset: float = 0.0
    timing: float = 0.0
    harmonics: dict[int, float] = field(default_factory=dict)
    bias: Any = None
    scale: tuple[Any, Any] | None = None
    bias_prior: float = np.inf
    scale_prior: float = np.inf
    gradient: bool = False
    longest_piece: float = np.inf


LINEAR = Polynomial(1, 20.0, 50.0)
RATE_CUBIC = Polynomial(3, 0.0, 300.0 * DEG)
RATE_LINEAR = Polynomial(1, 0.0, 300.0 * DEG)


class NoEarth(Geometry):
    """A table on an Earth that does not turn: for the ranks that its rate would hide."""

    def earth_rate(self):
        return np.zeros(3)


class Engine(NamedTuple):
    """A gyro along the only axis of a table, in the engine's terms."""

    motion: TableMotion
    model: ImuModel
    nodes: BodyNodes

    def system(self) -> tuple[NoiseSteps, np.ndarray]:
        return imu_system(self.motion, self.model, self.nodes)

    def posterior(self) -> Posterior:
        return posterior(imu_information(self.motion, self.model, self.nodes)[0])

    def deviations(self) -> np.ndarray:
        """Of the reported parameters."""
        return self.posterior().deviations(self.model.to_reported)


def one_axis(
    plan: Schedule, gyro: Channel, encoder: EncoderNoise, lag: float | None = None, installation: tuple = ()
) -> Engine:
    """The engine's view of a plan."""
    line = plan.trajectory(lag)
    if lag is not None:
        decays = np.ceil(np.log2(np.maximum(line.duration / lag / 8.0, 1.0))).astype(int)
        pieces = np.repeat(np.arange(len(decays)), decays)
        line, _ = line.divided(pieces, 0.5 ** np.concatenate([np.arange(n, 0, -1.0) for n in decays]))
    geometry = NoEarth(np.eye(3)[:1], np.eye(3), np.eye(3)[None], np.zeros(()), np.zeros(()))
    axis = np.where(line.moving, 0, -1)
    waves = max((order for term in installation for order in term.orders), default=0)
    motion = trajectory.table_motion(line, axis, np.zeros(len(axis), int), geometry, np.zeros(1), waves or None, 16)
    maps = [term for term in gyro.terms if isinstance(term, models.Map)]
    warm = tuple(sorted({b for term in maps for b in term.temperature.breaks}))
    fast = tuple(sorted({b for term in maps if term.rate is not None for b in term.rate.breaks}))
    motion = trajectory.divided_motion(motion, warm, {0: fast} if fast else {})
    model = ImuModel((gyro,), installation, encoder)
    return Engine(motion, model, trajectory.body_nodes(motion, 16))


def scale_map(temperature, rate, **more) -> models.Map:
    """M(T, ω) of a gyro along x."""
    return make_map(temperature, rate, name=SCALE_FACTOR, symbol="b", unit="1", signals=("rate x",), **more)


def gyro_x(terms, white: float = 1e-5, processes: models.Processes | None = None) -> Channel:
    """A gyro along x, with the discrepancies of its maps as the last terms."""
    maps = [term for term in terms if isinstance(term, models.Map)]
    every = (*terms, *(m.beyond for m in maps if m.beyond is not None))
    return Channel(every, np.asarray(white), models.no_processes() if processes is None else processes, "gyro", 0)


def encoder(reading: float = 0.0, offset: float = 0.0, timing: float = 0.0, rate: float = 0.0) -> EncoderNoise:
    """An encoder that is read as it stands."""
    of = (np.array([offset]), np.array([reading]), np.array([np.inf]))
    return EncoderNoise(*of, False, np.array([timing]), np.asarray(rate), bool(offset))


def core(scene: Scene) -> Engine:
    """The engine's plan and model of a scene."""
    moves, after = (tuple(core_move(a, scene.longest_piece) for a in acts) for acts in (scene.moves, scene.after))
    course = trajectory.programme(scene.start, list(scene.stretches))
    plan = trajectory.gradient_plan(course, moves, after, used=scene.used, read_every=scene.read_every)
    orders = tuple(scene.harmonics)
    waves = (AxisHarmonics(np.repeat(list(scene.harmonics.values()), 2), orders, 0, "x"),) if orders else ()
    noise = encoder(scene.reading_noise, scene.offset, scene.timing)
    return one_axis(plan, core_model(scene), noise, scene.lag, waves)


def core_move(act: Act, longest: float) -> trajectory.Move:
    if act.shape == "rest":
        return trajectory.rest(act.duration, act.every)
    how = {"ramp": act.ramp, "unevenness": act.unevenness, "read_every": act.every, "longest_piece": longest}
    return trajectory.turn(act.shape, act.peak, act.duration, **how)


def core_model(scene: Scene) -> Channel:
    processes = models.no_processes()
    for noise in scene.noises:
        gains = {"bias_gain": noise.bias_gain, "rate_gain": noise.rate_gain}
        if noise.kind == "walk":
            processes = processes + models.rate_random_walk(noise.size)
        elif noise.kind == "constant":
            processes = processes + models.constant(noise.size, **gains)
        else:
            processes = processes + models.gauss_markov(noise.size, noise.tau, **gains)
    terms: list[models.Term] = []
    if scene.bias is not None:
        terms.append(make_map(scene.bias, prior_std=scene.bias_prior, numbered=True))
    if scene.scale is not None:
        terms.append(scale_map(*scene.scale, prior_std=scene.scale_prior))
    if scene.gradient:
        terms.append(GradientOfBias(std=np.inf))
    return gyro_x(tuple(terms), scene.arw, processes)


# --- the scene, walked through by itself ------------------------------------------------------------------------------


def textbook_rate(act: Act, t: np.ndarray) -> np.ndarray:
    """Rate of a move `t` seconds after its start, from the shape's definition."""
    u = t / act.duration
    if act.shape == "rest":
        return np.zeros_like(t)
    if act.shape in ("cosine ramps", "linear ramps"):
        rising = np.clip(np.minimum(t, act.duration - t) / act.ramp, 0.0, 1.0)
        return act.peak * (rising if act.shape == "linear ramps" else 0.5 - 0.5 * np.cos(np.pi * rising))
    assert act.shape == "hand"
    return act.peak * np.sin(np.pi * u) ** 2 * (1.0 + act.unevenness * np.sin(6.0 * np.pi * u))


def _smooth_breaks(act: Act) -> np.ndarray:
    """Where a move's rate is not smooth, or a fixed rule needs help (fractions of the move)."""
    if act.shape in ("cosine ramps", "linear ramps"):
        r = act.ramp / act.duration
        return np.unique([r / 2, r, 1 - r, 1 - r / 2])
    return np.linspace(0.0, 1.0, {"hand": 16, "rest": 1}[act.shape] + 1)[1:-1]


class Reading(NamedTuple):
    time: float
    standstill: int  # −1 on the move
    rate: float = 0.0
    origin: int = 0


class Walk(NamedTuple):
    """What happens, in order: `acts` as (start, act); `readings`, each with the number of the origin, a reading, too,
    that it counts from."""

    begin: float
    end: float
    acts: list[tuple[float, Act]]
    readings: list[Reading]
    origins: list[Reading]


def walk(scene: Scene) -> Walk:
    """The scene's acts and readings."""
    knots = np.cumsum([0.0, *(d for d, _ in scene.stretches)])
    used = scene.used or ((0, len(knots) - 1),)
    own = sum(a.duration for a in scene.moves)
    period = own + sum(a.duration for a in scene.after)
    found = Walk(float(knots[used[0][0]]), float(knots[used[-1][1]]), [], [], [])
    clock, standstill = found.begin, 0
    for number, (first, last) in enumerate(used):
        if number:
            found.acts.append((clock, Act("rest", float(knots[first]) - clock)))
            clock = float(knots[first])
        found.origins.append(Reading(clock, standstill))
        available = float(knots[last] - knots[first])
        cycles = int((available - own) / period + 1e-9) + 1 if scene.moves else 0
        line = [a for k in range(cycles) for a in (*scene.moves, *(scene.after if k < cycles - 1 else ()))]
        left = available - sum(a.duration for a in line)
        if left > 1e-6:
            line.append(Act("rest", left, every=scene.read_every))
        for act in line:
            turning = act.shape != "rest"
            times = [act.duration] if turning else []
            if act.every is not None:
                times = [act.every * k for k in range(1, int(act.duration / act.every + 1e-9) + 1)]
            standstill += turning
            for t in times:
                on_the_way = turning and t < act.duration * (1 - 1e-9)
                rate = float(textbook_rate(act, np.array(t))) if on_the_way else 0.0
                found.readings.append(Reading(clock + t, -1 if on_the_way else standstill, rate, number))
            found.acts.append((clock, act))
            clock += act.duration
    return found


def sensor_temperature(scene: Scene, times: np.ndarray) -> np.ndarray:
    """Temperature of the die: the chamber's, behind a first-order lag, in equilibrium at the start."""
    knots = np.cumsum([0.0, *(d for d, _ in scene.stretches)])
    chamber = scene.start + np.cumsum([0.0, *(d * s for d, s in scene.stretches)])
    if scene.lag is None:
        return np.interp(times, knots, chamber)
    out, sensor = np.empty_like(times), chamber[0]
    for k, (duration, slope) in enumerate(scene.stretches):
        # The response to a ramp from rest, and the decay of what the sensor was behind at the stretch's start.
        here = (times >= knots[k]) if k else np.ones_like(times, bool)
        t = np.append(times[here] - knots[k], duration)
        lagging = (sensor - chamber[k]) * np.exp(-t / scene.lag)
        of_sensor = chamber[k] + lagging + slope * (t + scene.lag * np.expm1(-t / scene.lag))
        out[here], sensor = of_sensor[:-1], of_sensor[-1]
    return out


def rate_at(found: Walk, times: np.ndarray) -> np.ndarray:
    """Rate of the channel at any times."""
    starts = np.array([s for s, _ in found.acts])
    index = np.clip(np.searchsorted(starts, times, side="right") - 1, 0, len(starts) - 1)
    out = np.zeros_like(times)
    for k in np.unique(index):
        here = index == k
        out[here] = textbook_rate(found.acts[k][1], times[here] - starts[k])
    return out


def reported_functions(basis: Any, x: np.ndarray) -> np.ndarray:
    """A basis as people read it, on a new last axis: normalised monomials, B-splines (SciPy's) or indicators."""
    if isinstance(basis, Polynomial):
        return ((x - basis.centre) / basis.scale)[..., None] ** np.arange(basis.degree + 1)
    if isinstance(basis, BSpline):
        k = basis.knots
        t = np.r_[[k[0]] * basis.degree, k, [k[-1]] * basis.degree]
        spline = ScipyBSpline(t, np.eye(basis.size), basis.degree)
        return spline(np.clip(x, k[0], k[-1]))
    edges = basis.edges
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    return np.eye(len(edges) - 1)[index]


_GAUSS = np.polynomial.legendre.leggauss(24)
_X, _W = (_GAUSS[0] + 1.0) / 2.0, _GAUSS[1] / 2.0


class Reference(NamedTuple):
    """Regressors of all readings in *reported* coefficients, `(R, p)`, and the covariance of their noise, `(R, R)`."""

    regressors: np.ndarray
    covariance: np.ndarray


def panels(scene: Scene, found: Walk) -> np.ndarray:
    """Times between which everything is smooth and slow enough for one Gauss rule."""
    edges = [found.begin, found.end, *(r.time for r in found.readings), *(o.time for o in found.origins)]
    edges += list(np.cumsum([0.0, *(d for d, _ in scene.stretches)]))
    for start, act in found.acts:
        edges += [start, start + act.duration, *(start + act.duration * _smooth_breaks(act))]
    edges = np.unique(np.clip(np.array(edges), found.begin, found.end))
    edges = edges[np.r_[True, np.diff(edges) > 1e-9]]
    longest = min([30.0, *(n.tau for n in scene.noises)])
    fine = [np.linspace(a, b, int(np.ceil((b - a) / longest)) + 1)[:-1] for a, b in pairwise(edges)]
    edges = np.r_[np.concatenate(fine), edges[-1]]
    warm = [b for basis in (scene.bias, scene.scale and scene.scale[0]) if basis is not None for b in basis.breaks]
    fast = scene.scale[1].breaks if scene.scale else ()
    crossings: list[float] = []
    for of, breaks in ((partial(sensor_temperature, scene), warm), (partial(rate_at, found), fast)):
        for a, b in pairwise(edges if len(breaks) else ()):
            grid = np.linspace(a, b - 1e-12 * max(1.0, abs(b)), 17)
            for level in breaks:
                above = of(grid) - level
                for i in np.flatnonzero(above[:-1] * above[1:] < 0.0):
                    crossings.append(brentq(_apart, grid[i], grid[i + 1], (of, level), xtol=1e-13, rtol=1e-15))
    return np.unique(np.r_[edges, crossings])


def _apart(t: float, of: Callable[[np.ndarray], np.ndarray], level: float) -> float:
    return float(of(np.array([t]))[0]) - level


def reference(scene: Scene) -> Reference:
    """Everything by integration over the scene; nothing of the engine's is used but the bases' definitions."""
    found = walk(scene)
    edges = panels(scene, found)
    a, width = edges[:-1], np.diff(edges)
    times = a[:, None] + width[:, None] * _X
    weight = width[:, None] * _W
    rate, temperature = rate_at(found, times), sensor_temperature(scene, times)

    blocks = []
    if scene.bias is not None:
        blocks.append(np.einsum("pq,pqa->pa", weight, reported_functions(scene.bias, temperature)))
    if scene.scale is not None:
        of_t, of_w = (reported_functions(b, x) for b, x in zip(scene.scale, (temperature, rate), strict=True))
        both = np.einsum("pq,pqa,pqb->pab", weight * rate, of_t, of_w)
        blocks.append(both.reshape(len(a), -1))
    if scene.gradient:
        ends = sensor_temperature(scene, edges)
        blocks.append(np.diff(ends)[:, None])
    increments = np.concatenate(blocks, axis=1)
    turned = np.r_[0.0, np.cumsum(np.sum(weight * rate, axis=1))]

    time, still, speed, of = np.array(found.readings).T
    begin, first = (column[of.astype(int)] for column in np.array(found.origins).T[:2])
    upto, origin = (np.argmin(np.abs(edges - t[:, None]), axis=1) for t in (time, begin))
    number = np.arange(len(a))
    within = ((number[None] >= origin[:, None]) & (number[None] < upto[:, None])).astype(Extended)
    regressors = within @ increments.astype(Extended)
    for order in scene.harmonics:
        for wave in (lambda phi, order=order: -np.cos(order * phi), lambda phi, order=order: -np.sin(order * phi)):
            regressors = np.c_[regressors, (wave(turned[upto]) - wave(turned[origin])).astype(Extended)]

    motion = np.diag((scene.arw**2 * width).astype(Extended))
    for noise in scene.noises:
        motion = motion + _kernel_blocks(noise, found, a, width, times, weight, rate)
    covariance = within @ motion @ within.T

    # The noise of each reading and of the one that it counts from; the offsets of both standstills.
    white = np.c_[np.eye(len(time)), -np.eye(len(found.origins))[of.astype(int)]]
    size = np.r_[np.hypot(scene.reading_noise, scene.timing * speed), [scene.reading_noise] * len(found.origins)]
    numbers = np.arange(still.max() + 1.0)
    standing = (still[:, None] == numbers) * 1.0 - (first[:, None] == numbers)
    covariance = covariance + (white * size.astype(Extended) ** 2) @ white.T + scene.offset**2 * standing @ standing.T
    return Reference(regressors, covariance)


def _kernel_blocks(noise: Noise, found: Walk, a, width, times, weight, rate) -> np.ndarray:
    """`∫∫ c(s)c(s') K(s, s') ds ds'` over all pairs of panels, K the process's own covariance function."""
    c = noise.bias_gain + noise.rate_gain * rate
    whole = np.sum(weight * c, axis=1)
    if noise.kind == "constant":
        return np.multiply.outer(whole, whole).astype(Extended) * noise.size**2
    inner = a[:, None, None] + (times - a[:, None])[:, :, None] * _X
    inner_weight = (times - a[:, None])[:, :, None] * _W
    inner_c = noise.bias_gain + noise.rate_gain * rate_at(found, inner)
    lower = np.tril(np.ones((len(a), len(a))), -1)
    if noise.kind == "walk":
        since = times - found.begin
        early = np.sum(weight * c * since, axis=1)
        blocks = np.multiply.outer(whole, early) * lower
        diagonal = 2.0 * np.einsum("pq,pq,pqr->p", weight, c, inner_weight * inner_c * (inner - found.begin))
    else:
        onward = np.sum(weight * c * np.exp(-((a + width)[:, None] - times) / noise.tau), axis=1)
        from_start = np.sum(weight * c * np.exp(-(times - a[:, None]) / noise.tau), axis=1)
        apart = np.maximum(a[:, None] - (a + width)[None, :], 0.0)
        blocks = from_start[:, None] * np.exp(-apart / noise.tau) * onward[None, :] * lower
        fading = inner_weight * inner_c * np.exp(-(times[:, :, None] - inner) / noise.tau)
        diagonal = 2.0 * np.einsum("pq,pq,pqr->p", weight, c, fading)
    return (blocks + blocks.T + np.diag(diagonal)).astype(Extended) * noise.size**2


# --- roads to the covariance ------------------------------------------------------------------------------------------


def cholesky(matrix: np.ndarray) -> np.ndarray:
    """Lower triangular factor in extended precision."""
    work = np.array(matrix, Extended)
    n = len(work)
    for k in range(n):
        if not work[k, k] > 0:
            raise np.linalg.LinAlgError("not positive definite")
        work[k, k] = np.sqrt(work[k, k])
        work[k + 1 :, k] /= work[k, k]
        work[k + 1 :, k + 1 :] -= np.multiply.outer(work[k + 1 :, k], work[k + 1 :, k])
    return np.tril(work)


def forward(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """`L⁻¹ right` in extended precision."""
    x = np.array(right, Extended)
    for k in range(len(lower)):
        x[k] = (x[k] - lower[k, :k] @ x[:k]) / lower[k, k]
    return x


def dense_gls(
    regressors: np.ndarray, covariance: np.ndarray, prior: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and covariance of dense generalised least squares; `prior`: whitened rows."""
    scale = np.sqrt(np.diagonal(covariance))
    rows = forward(cholesky(covariance / np.multiply.outer(scale, scale)), regressors / scale[:, None])
    if prior is not None:
        rows = np.concatenate([rows, prior.astype(Extended)])
    norm = np.sqrt(np.sum(rows**2, axis=0))
    rows = rows / norm
    inverse = forward(cholesky(rows.T @ rows), np.eye(rows.shape[1]))
    posterior = inverse.T @ inverse / np.multiply.outer(norm, norm)
    return np.sqrt(np.diagonal(posterior)).astype(float), posterior.astype(float)


def prior_rows_reported(scene: Scene, count: int) -> np.ndarray:
    """Whitened rows of the priors on reported coefficients and of the harmonics."""
    sizes = [0 if scene.bias is None else scene.bias.size]
    sizes.append(0 if scene.scale is None else scene.scale[0].size * scene.scale[1].size)
    weights = [1.0 / scene.bias_prior] * sizes[0] + [1.0 / scene.scale_prior] * sizes[1]
    weights += [0.0] if scene.gradient else []
    weights += [1.0 / amplitude for amplitude in scene.harmonics.values() for _ in range(2)]
    rows = np.diag(weights)
    assert rows.shape == (count, count)
    return rows[np.array(weights) > 0.0]


def augmented_kalman(steps: NoiseSteps, columns: np.ndarray, prior_covariance: np.ndarray) -> np.ndarray:
    """The paper's filter: parameters appended to the noise's state, textbook equations. Posterior of the parameters."""
    n, p = steps.observation.shape[1], columns.shape[1]
    state = np.zeros((n + p, n + p))
    state[:n, :n], state[n:, n:] = steps.initial, prior_covariance
    for f, q, h, r, used, phi in zip(*(np.asarray(x) for x in steps[:5]), np.asarray(columns), strict=True):
        whole = np.eye(n + p)
        whole[:n, :n] = f
        state = whole @ state @ whole.T
        state[:n, :n] += q
        if used:
            observe = np.r_[h, phi]
            gain = state @ observe
            state = state - np.outer(gain, gain) / (observe @ gain + r)
            state = 0.5 * (state + state.T)
    return state[n:, n:]


def dense_of(steps: NoiseSteps) -> np.ndarray:
    """Covariance of the used rows, from the steps written out."""
    n = steps.observation.shape[1]
    spread, response = [np.asarray(steps.initial)], [np.eye(n)]
    rows = []
    for f, q, h, r, used in zip(*(np.asarray(x) for x in steps[:5]), strict=True):
        response = [f @ x for x in response] + [np.eye(n)]
        spread.append(q)
        if used:
            rows.append(([h @ x for x in response], r))
    total = np.zeros((len(rows), len(rows)))
    for i, (a, r) in enumerate(rows):
        total[i, i] += r
        for j, (b, _) in enumerate(rows):
            total[i, j] += sum(x @ q @ y for x, q, y in zip(a, spread, b, strict=False))
    return total


# --- scenes -----------------------------------------------------------------------------------------------------------

_TURNS = (
    Act("rest", 6.0, every=2.0),
    Act("cosine ramps", 5.0, 150 * DEG, ramp=0.8),
    Act("linear ramps", 4.0, -290 * DEG, ramp=1.5),
    Act("cosine ramps", 6.0, 120 * DEG, ramp=2.0, every=1.5),
    Act("hand", 7.0, -60 * DEG),
    Act("rest", 4.0, every=2.0),
)
_CURVES = (
    Act("linear ramps", 12.0, 80 * DEG, ramp=5.0, every=2.5),
    Act("rest", 5.0, every=1.0),
    Act("cosine ramps", 9.0, 200 * DEG, ramp=2.0),
    Act("hand", 20.0, -30 * DEG, unevenness=0.3),
    Act("rest", 3.0, every=3.0),
)

DRIFT = Noise("drift", 1.0 * DEG_PER_H, 120.0)
SCENES: dict[str, Scene] = {
    # White readings, one drift, one long ramp: the paper's kind.
    "paper-like": Scene(
        -30.0,
        ((400.0, 0.25),),
        _TURNS,
        (Act("rest", 20.0, every=2.0), Act("rest", 7.0)),
        read_every=3.0,
        noises=(DRIFT,),
        scale=(LINEAR, RATE_CUBIC),
        scale_prior=1e-2,
    ),
    # A drift mixture (one shorter than the moves), offsets, timing error, harmonics, bias and its sensitivity to dT/dt,
    # and a lagging sensor that turns round.
    "everything": Scene(
        -20.0,
        ((150.0, 0.4), (100.0, 0.0), (170.0, -0.3)),
        _CURVES + _TURNS[1:3],
        (Act("rest", 15.0, every=3.0),),
        read_every=5.0,
        lag=60.0,
        noises=(
            Noise("drift", 20.0 * DEG_PER_H, 1.5),
            Noise("walk", 0.02 * DEG_PER_H),
            Noise("scale", 50e-6, 70.0, 0.0, 1.0),
            Noise("both", 0.1, 200.0, 5.0 * DEG_PER_H, 15e-6),
        ),
        offset=0.01 * DEG,
        timing=2e-4,
        harmonics={1: 0.01 * DEG, 3: 0.004 * DEG},
        bias=LINEAR,
        scale=(LINEAR, RATE_LINEAR),
        bias_prior=500 * DEG_PER_H,
        scale_prior=1e-2,
        gradient=True,
        longest_piece=100.0,
    ),
    # Two used stretches with a gap, offsets, and constants drawn once.
    "gap": Scene(
        -10.0,
        ((50.0, 0.0), (120.0, 0.2), (60.0, 0.0), (130.0, 0.25), (20.0, 0.0)),
        _TURNS[:3],
        (Act("rest", 10.0, every=2.0),),
        used=((1, 2), (3, 4)),
        read_every=4.0,
        noises=(DRIFT, Noise("constant", 3.0 * DEG_PER_H), Noise("constant", 20e-6, rate_gain=1.0, bias_gain=0.0)),
        offset=0.02 * DEG,
        scale=(LINEAR, RATE_LINEAR),
        scale_prior=1e-2,
    ),
    # Other bases: B-splines in temperature, bins in rate; bias on bins.
    "bases": Scene(
        0.0,
        ((300.0, 0.15),),
        _TURNS,
        (Act("rest", 12.0, every=2.0),),
        read_every=5.0,
        noises=(DRIFT,),
        bias=BSpline((-5.0, 12.0, 30.0, 50.0), 0),
        scale=(BSpline((-10.0, 20.0, 60.0), 2), BSpline((-6.0, -1.0, 1.0, 6.0), 0)),
        bias_prior=500 * DEG_PER_H,
        scale_prior=1e-2,
    ),
}
