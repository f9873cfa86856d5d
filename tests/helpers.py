"""The zoo: scenes with every motion, noise and reference, and slow roads to their covariance.

A `Scene` is plain numbers (SI, °C). `core` makes the engine's plan and model of it. `reference` has the regressors and
the covariance of all readings by composite Gauss–Legendre integration of the processes' *kernels* over the course (no
recursion, no state).
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

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


def textbook_rate(act: Act, t: np.ndarray) -> np.ndarray:
    """Rate of a turn `t` seconds after its start, from the shape's definition."""
    if act.shape == "hand":
        u = t / act.duration
        return act.peak * np.sin(np.pi * u) ** 2 * (1.0 + act.unevenness * np.sin(6.0 * np.pi * u))
    rising = np.clip(np.minimum(t, act.duration - t) / act.ramp, 0.0, 1.0)
    return act.peak * (rising if act.shape == "linear ramps" else 0.5 - 0.5 * np.cos(np.pi * rising))


# --- the covariance by integrals over the course ----------------------------------------------------------------------

_GAUSS = np.polynomial.legendre.leggauss(24)
_X, _W = (_GAUSS[0] + 1.0) / 2.0, _GAUSS[1] / 2.0


def reference(scene: Scene, made: Engine) -> tuple[np.ndarray, np.ndarray]:
    """Regressors of all readings `(R, p)` in the engine's coordinates, and the covariance of their noise `(R, R)`.

    Of the engine's are the course alone, whose times, rates and temperatures `tests/motion` proves, and the bases."""
    line = made.motion.line
    # Each piece in panels `(P,)` that are short enough for one Gauss rule.
    parts = np.ceil(line.duration / min([30.0, *(n.tau for n in scene.noises)])).astype(int)
    piece, ends = np.repeat(np.arange(line.piece_count), parts), np.cumsum(parts)
    share, number = 1.0 / parts[piece], np.arange(len(piece))
    before = (number - (ends - parts)[piece]) * share
    places, inner = (before[:, None] + share[:, None] * x for x in (_X, np.outer(_X, _X).ravel()))
    rate, temperature, width = line.rate(places, piece), line.temperature(places, piece), line.duration[piece] * share
    weight = width[:, None] * _W
    blocks = [] if scene.bias is None else [np.einsum("pq,pqa->pa", weight, scene.bias(temperature))]
    if scene.scale is not None:
        both = np.einsum("pq,pqa,pqb->pab", weight * rate, scene.scale[0](temperature), scene.scale[1](rate))
        blocks.append(both.reshape(len(both), -1))
    if scene.gradient:
        warmer = line.temperature(before[:, None] + share[:, None] * [0.0, 1.0], piece)
        blocks.append(np.diff(warmer))
    turned = np.append(0.0, np.cumsum(np.sum(weight * rate, axis=1)))

    # Readings, and the origins that they count from: the begin, and the ends of gaps.
    read, gaps = np.flatnonzero(line.read), np.flatnonzero(line.gap)
    of = np.searchsorted(gaps, read)
    until, origin = ends[read], np.append(0, ends[gaps])
    within = ((number >= origin[of, None]) & (number < until[:, None])) * 1.0
    regressors = within @ np.concatenate(blocks, axis=1)
    for order in scene.harmonics:
        for wave in (np.cos, np.sin):
            regressors = np.c_[regressors, wave(order * turned[origin[of]]) - wave(order * turned[until])]

    inner_rate = line.rate(inner, piece).reshape(*rate.shape, -1)
    begin = line.start[piece] + before * line.duration[piece] - line.start[0]
    motion = np.diag(scene.arw**2 * width)
    for noise in scene.noises:
        motion = motion + noise.size**2 * _kernel_blocks(noise, begin, width, rate, inner_rate)
    covariance = within @ motion @ within.T
    # The noise of each reading and of the one that it counts from; the offsets of both standstills.
    white, rest = np.c_[np.eye(len(read)), -np.eye(len(origin))[of]], line.at_rest[read]
    on_move = np.where(rest, 0.0, scene.timing * line.end_rate()[read])
    size = np.append(np.hypot(scene.reading_noise, on_move), np.full(len(origin), scene.reading_noise))
    moves = np.cumsum(line.moving & (np.diff(line.segment, append=-1) != 0))
    numbers = np.arange(moves[-1] + 1)
    now = (moves[read, None] == numbers) & rest[:, None]
    standing = now * 1.0 - (np.append(0, moves[gaps])[of, None] == numbers)
    covariance = covariance + (white * size**2) @ white.T + scene.offset**2 * standing @ standing.T
    return regressors, covariance


def _kernel_blocks(noise: Noise, begin, width, rate, inner_rate) -> np.ndarray:
    """`∫∫ c(s)c(s') K(s, s') ds ds'` over all pairs of panels, K the process's own covariance function of size 1."""
    weight, since = width[:, None] * _W, width[:, None] * _X
    c, inner_c = (noise.bias_gain + noise.rate_gain * of for of in (rate, inner_rate))
    whole = np.sum(weight * c, axis=1)
    if noise.kind == "constant":
        return np.outer(whole, whole)
    inner_weight, inner = since[:, :, None] * _W, since[:, :, None] * _X
    if noise.kind == "walk":
        early = begin[:, None] + since
        apart = np.outer(whole, np.sum(weight * c * early, axis=1))
        kernel = begin[:, None, None] + inner
    else:
        onward, from_start = (
            np.sum(weight * c * np.exp(-t / noise.tau), axis=1) for t in (width[:, None] - since, since)
        )
        between = np.maximum(begin[:, None] - (begin + width), 0.0)
        apart = from_start[:, None] * np.exp(-between / noise.tau) * onward
        kernel = np.exp(-(since[:, :, None] - inner) / noise.tau)
    apart = np.tril(apart, -1)
    own = 2.0 * np.einsum("pq,pq,pqr->p", weight, c, inner_weight * inner_c * kernel)
    return apart + apart.T + np.diag(own)


# --- roads to the covariance ------------------------------------------------------------------------------------------


def dense_gls(regressors: np.ndarray, covariance: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Standard deviations of dense generalised least squares; `prior`: whitened rows."""
    scale = np.sqrt(np.diagonal(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(scale, scale))
    rows = np.concatenate([solve_triangular(lower, regressors / scale[:, None], lower=True), prior])
    norm = np.linalg.norm(rows, axis=0)
    inverse = solve_triangular(np.linalg.qr(rows / norm, mode="r"), np.eye(len(norm)))
    return np.linalg.norm(inverse, axis=1) / norm


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
