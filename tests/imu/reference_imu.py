"""A second opinion on whole units that shares nothing with the program but a scene's plain numbers.

`Scene` is a table, a plan and a unit. `Simulator` goes through it with the finite geometry: rotation matrices, angles
and rates of cosine ramps by their textbook formulas, composite Gauss–Legendre quadrature. What a small installation
error changes is the derivative of those finite readings by it, by the complex step (exact to rounding). `dense` is
generalised least squares with the processes' covariance functions: no recursion, no state.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from helpers import dense_gls
from imu_helpers import AXES, Step, cosine_ramps
from imu_twin import OMEGA, Course, Leg, angles_of

_X, _W = np.polynomial.legendre.leggauss(16)
_X, _W = 0.5 * (_X + 1.0), 0.5 * _W
_STEP = 1e-30


@dataclass(frozen=True)
class Scene:
    """Everything that a unit's covariance depends on, SI and °C. `axes` outermost first; `mountings` body to the
    innermost axis. `drift`, `instability`: (σ, τ) of gyros, `force_drift` of accelerometers. `priors`: standard
    deviation by parameter family; `temperature`: at the beginning, and slope. `powers`: of temperature and rate.
    `held`: whether a table that stands is known not to turn.
    """

    axes: tuple[np.ndarray, ...]
    base: np.ndarray
    mountings: tuple[np.ndarray, ...]
    latitude: float
    gravity: float
    steps: tuple[Step, ...]
    start: tuple[float, ...]
    temperature: tuple[float, float]
    gyros: tuple[int, ...]
    accelerometers: tuple[int, ...]
    gyro_white: float
    force_white: float
    drift: tuple[tuple[float, float], ...]
    instability: tuple[tuple[float, float], ...]
    force_drift: tuple[tuple[float, float], ...]
    offset: tuple[float, ...]
    reading: tuple[float, ...]
    every: tuple[float, ...]
    orders: tuple[tuple[int, ...], ...]
    priors: dict[str, float]
    powers: tuple[int, int] = (1, 2)
    held: bool = True

    @property
    def centre_and_scale(self) -> tuple[float, float, float]:
        """Of temperature (°C, K), and the scale of rates (rad/s)."""
        return 20.0, 50.0, 5.0


def rotated(axis: np.ndarray, angle) -> np.ndarray:
    """Rotation matrices `(…, 3, 3)` by real or complex angles about a unit vector."""
    k = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    angle = np.asarray(angle)[..., None, None]
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def small(vector: np.ndarray) -> np.ndarray:
    """Rotation by a vector of real or complex components."""
    size = np.sqrt(np.sum(vector * vector))
    if size == 0.0:
        return np.eye(3)
    x, y, z = vector / size
    zero = 0.0 * x
    k = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return np.eye(3) + np.sin(size) * k + (1.0 - np.cos(size)) * (k @ k)


@dataclass
class Errors:
    """Finite errors of the installation; `angle`: of an axis's encoder and its rate, a function of (k, t, θ, θ̇)."""

    tau: np.ndarray
    delta: np.ndarray
    mu: np.ndarray
    gravity: complex = 0.0
    angle: tuple[int, Callable] | None = None


def _leg(step: Step) -> Leg:
    if step.axis < 0:
        return Leg(-1, step.duration)
    _, ramp, duration = cosine_ramps(step.angle, step.peak, step.acceleration)
    return Leg(step.axis, duration, step.angle, ramp)


class Simulator:
    """The readings of a scene's segments, with any error of the installation."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self.legs = [_leg(step) for step in scene.steps]
        self.times = np.concatenate([[0.0], np.cumsum([leg.duration for leg in self.legs])])
        self.before = angles_of(self.legs, scene.start)
        self.nodes = [self._nodes(k) for k in range(len(scene.steps))]

    @property
    def none(self) -> Errors:
        return Errors(np.zeros(3), np.zeros(len(self.scene.axes) - 1), np.zeros((len(self.scene.mountings), 3)))

    def _nodes(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Times since the segment began, and weights."""
        leg, edges = self.legs[k], [0.0, self.legs[k].duration]
        if leg.axis >= 0:
            edges = np.unique([0.0, leg.ramp, max(leg.duration - leg.ramp, leg.ramp), leg.duration])
            top = abs(leg.angle) / (leg.duration - leg.ramp)
            edges = [x for a, b in pairwise(edges) for x in np.linspace(a, b, 2 + int((b - a) * top))[:-1]] + [
                edges[-1]
            ]
        t = np.concatenate([a + (b - a) * _X for a, b in pairwise(edges)])
        return t, np.concatenate([(b - a) * _W for a, b in pairwise(edges)])

    def travel(self, k: int, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle turned since a move began, and its rate."""
        leg = self.legs[k]
        course = Course([leg], t)
        return course.share * leg.angle, course.pace * leg.angle

    def stages(self, k: int, t: np.ndarray, errors: Errors) -> tuple[np.ndarray, np.ndarray]:
        """Attitude (body to East-North-Up) and the body's rate by the joints alone, at times within a segment."""
        scene, step = self.scene, self.scene.steps[k]
        turned, rate = self.travel(k, t)
        inner = scene.mountings[step.mounting] @ small(errors.mu[step.mounting])
        inner = np.broadcast_to(inner, (len(t), 3, 3))
        omega = np.zeros((len(t), 3))
        for l in reversed(range(len(scene.axes))):
            own = step.axis == l
            angle = self.before[k][l] + (turned if own else 0.0 * turned)
            speed = rate if own else 0.0 * rate
            if errors.angle is not None and errors.angle[0] == l:
                extra, faster = errors.angle[1](k, t, angle, speed)
                angle, speed = angle + extra, speed + faster
            if l + 1 < len(scene.axes):
                about = np.cross(scene.axes[l + 1], scene.axes[l])
                inner = small(errors.delta[l] * about) @ inner
            omega = omega + (np.swapaxes(inner, 1, 2) @ scene.axes[l]) * np.asarray(speed)[:, None]
            inner = rotated(scene.axes[l], angle) @ inner
        return small(errors.tau) @ scene.base @ inner, omega

    def seen(self, k: int, t: np.ndarray, errors: Errors) -> tuple[np.ndarray, np.ndarray]:
        """Rate and specific force in the body, `(n, 3)` each."""
        scene = self.scene
        attitude, omega = self.stages(k, t, errors)
        earth = OMEGA * np.array([0.0, np.cos(scene.latitude), np.sin(scene.latitude)])
        transposed = np.swapaxes(attitude, 1, 2)
        return transposed @ earth + omega, transposed @ np.array([0.0, 0.0, scene.gravity + errors.gravity])

    def readings(self, errors: Errors) -> np.ndarray:
        """`(S, 6)`: integrals of rate and force over every segment."""
        rows = []
        for k, (t, w) in enumerate(self.nodes):
            rate, force = self.seen(k, t, errors)
            rows.append(np.concatenate([w @ rate, w @ force]))
        return np.array(rows)

    # --- derivatives --------------------------------------------------------------------------------------------------

    def by(self, error_of: Callable[[complex], Errors]) -> np.ndarray:
        """Derivative of the readings at zero, by the complex step."""
        return np.imag(self.readings(error_of(1j * _STEP))) / _STEP

    def installation(self) -> dict[str, Callable[[complex], Errors]]:
        """Every installation error by its name: what makes it of a size."""
        scene, found = self.scene, {}

        def put(field: str, unit: np.ndarray | float):
            return lambda x: replace(self.none, **{field: unit * x})

        for unit, name in zip(np.eye(3), ("tilt_east", "tilt_north", "azimuth"), strict=True):
            found[name] = put("tau", unit)
        for l, unit in enumerate(np.eye(len(scene.axes) - 1)):
            found[f"orthogonality_axis{l}_axis{l + 1}"] = put("delta", unit)
        for l, orders in enumerate(scene.orders):
            for order in orders:
                for wave, phase in (("cos", 0.0), ("sin", -0.5 * np.pi)):
                    found[f"angle_axis{l}_{wave}{order}"] = self._harmonic(l, order, phase)
        for unit in np.eye(3 * len(scene.mountings)):
            (at,) = np.flatnonzero(unit)
            found[f"mounting{at // 3 + 1}_{AXES[at % 3]}"] = put("mu", unit.reshape(-1, 3))
        found["gravity"] = put("gravity", 1.0)
        return found

    def _harmonic(self, l: int, order: int, phase: float):
        """Told angle and true angle differ by the error at the told angle."""

        def wave(x, angle, speed):
            return x * np.cos(order * angle + phase), -x * order * np.sin(order * angle + phase) * speed

        return lambda x: replace(self.none, angle=(l, lambda k, t, angle, speed: wave(x, angle, speed)))

    def encoder(self, l: int, *, now: bool) -> Callable[[complex], Errors]:
        """Error of an axis at its standstill now, or at the one before the move that it makes."""

        def share(k, t):
            leg = self.legs[k]
            if leg.axis == l:
                course = Course([leg], t)
                return (course.share, course.pace) if now else (1.0 - course.share, -course.pace)
            if self.scene.held:
                return np.full(len(t), float(now)), np.zeros(len(t))
            # Straight from reading to reading; the attitude is turned by their mean.
            return np.full(len(t), 0.5), np.full(len(t), (1.0 if now else -1.0) / leg.duration)

        return lambda x: replace(self.none, angle=(l, lambda k, t, *_: [x * of for of in share(k, t)]))

    # --- the rows -----------------------------------------------------------------------------------------------------

    def rows(self) -> list[tuple[int, int]]:
        """(segment, channel) in order; channels 0–2 are gyros, 3–5 accelerometers, read at rest."""
        scene = self.scene
        channels = [*scene.gyros, *(3 + i for i in scene.accelerometers)]

        def read(s: Step, c: int) -> bool:
            return c < 3 or s.axis < 0

        return [(k, c) for k, s in enumerate(scene.steps) for c in channels if read(s, c)]

    def own_columns(self) -> dict[str, np.ndarray]:
        """Columns of the channels' own terms by reported name, over `rows`."""
        scene, rows = self.scene, self.rows()
        centre, scale, rate_scale = scene.centre_and_scale
        found = defaultdict[str, np.ndarray](lambda: np.zeros(len(rows)))
        for row, (k, c) in enumerate(rows):
            t, w = self.nodes[k]
            rate, force = self.seen(k, t, self.none)
            x = (scene.temperature[0] + scene.temperature[1] * (self.times[k] + t) - centre) / scale
            name, vector, bias = ("gyro", rate, "a") if c < 3 else ("accelerometer", force, "b")
            name, own = f"{name}_{AXES[c % 3]}.", vector[:, c % 3]
            for q in range(scene.powers[0] + 1):
                found[f"{name}{bias}{q}"][row] = w @ x**q
                for j in {0, 1, 2} - {c % 3}:
                    found[f"{name}m_{AXES[j]}{q}"][row] = w @ (x**q * vector[:, j])
                for r in range(scene.powers[1] + 1 if c < 3 else 0):
                    found[f"{name}b{r}{q}"][row] = w @ (x**q * (own / rate_scale) ** r * own)
                if c >= 3:
                    found[f"{name}s{q}"][row] = w @ (x**q * own)
            if c >= 3:
                found[f"{name}k2"][row] = w @ own**2
            for j in range(3 if c < 3 else 0):
                found[f"{name}g_{AXES[j]}"][row] = w @ force[:, j]
        return found

    def columns(self) -> dict[str, np.ndarray]:
        """All columns by reported name, over `rows`."""
        found, rows = self.own_columns(), self.rows()
        segment, channel = (np.array(v) for v in zip(*rows, strict=True))
        for name, error_of in self.installation().items():
            found[name] = self.by(error_of)[segment, channel]
        found["sample_clock"] = self.readings(self.none)[segment, channel]
        return found

    # --- covariance ---------------------------------------------------------------------------------------------------

    def standstills(self, l: int) -> tuple[np.ndarray, np.ndarray]:
        """Number of axis l's standstill in force at each segment's end, and the variance of every one."""
        scene = self.scene
        moves = [k for k, s in enumerate(scene.steps) if s.axis == l]
        number = np.searchsorted(moves, np.arange(len(scene.steps)), side="right")
        begins = [0.0, *(self.times[k + 1] for k in moves)]
        ends = [*(self.times[k] for k in moves), self.times[-1]]
        count = [np.floor((b - a) / scene.every[l] * (1 + 1e-9) + 1e-9) + 1 for a, b in zip(begins, ends, strict=True)]
        return number, scene.offset[l] ** 2 + scene.reading[l] ** 2 / np.array(count)

    def covariance(self) -> np.ndarray:
        """Of all rows."""
        scene, rows = self.scene, self.rows()
        segment, channel = (np.array(v) for v in zip(*rows, strict=True))
        a, b = self.times[segment], self.times[segment + 1]
        lasting = b - a
        white = np.where(channel < 3, scene.gyro_white, scene.force_white)
        total = np.diag(white**2 * lasting)
        same = channel[:, None] == channel[None, :]
        for processes, gyros in ((scene.drift, True), (scene.force_drift, False)):
            which = same & ((channel < 3) == gyros)[:, None]
            for sigma, tau in processes:
                total = total + np.where(which, sigma**2 * _gauss_markov(a, b, tau), 0.0)
        for sigma, tau in scene.instability:
            for i in scene.gyros:
                own = np.flatnonzero(channel == i)
                total[np.ix_(own, own)] += sigma**2 * self._driven(i, segment[own], tau)
        for l in range(len(scene.axes)):
            number, variance = self.standstills(l)
            if not scene.held:
                total = total + self._of_readings(l, number, segment, channel)
                continue
            now, before = (self.by(self.encoder(l, now=n))[segment, channel] for n in (True, False))
            share = np.zeros((len(rows), len(variance)))
            share[np.arange(len(rows)), number[segment]] += now
            moved = np.array([scene.steps[k].axis == l for k in segment])
            share[moved, number[segment][moved] - 1] += before[moved]
            total = total + (share * variance) @ share.T
        return total

    def _of_readings(self, l: int, number: np.ndarray, segment: np.ndarray, channel: np.ndarray) -> np.ndarray:
        """Of an encoder that is read at the end of every segment, and once before the first."""
        scene, count = self.scene, len(self.scene.steps)
        of_reading, of_standstill = np.zeros((len(segment), count + 1)), np.zeros((len(segment), count + 1))
        standstill = np.concatenate([[0], number])
        for now in (True, False):
            effect = self.by(self.encoder(l, now=now))[segment, channel]
            reading = segment + int(now)
            of_reading[np.arange(len(segment)), reading] += effect
            np.add.at(of_standstill, (np.arange(len(segment)), standstill[reading]), effect)
        white, drawn = scene.reading[l] ** 2, scene.offset[l] ** 2
        return white * of_reading @ of_reading.T + drawn * of_standstill @ of_standstill.T

    def _driven(self, i: int, segments: np.ndarray, tau: float) -> np.ndarray:
        """`∫∫ω(t)ω(s) exp(−|t − s|/τ)` over all pairs of segments; ω of the table alone, as the program has it."""

        def rate(k, t):
            return self.stages(k, t, self.none)[1][:, i]

        a, b = self.times[segments], self.times[segments + 1]
        late, early, own = [], [], []
        for k in segments:
            t, w = self.nodes[k]
            whole = self.times[k + 1] - self.times[k]
            values = rate(k, t)
            late.append(w @ (values * np.exp(-(whole - t) / tau)))
            early.append(w @ (values * np.exp(-t / tau)))
            if not np.any(values):
                own.append(0.0)
                continue
            # ∫₀ᵗ by panels: all before t's panel, and Gauss within it.
            panels = len(t) // len(_X)
            edges = np.concatenate([[0.0], np.cumsum(w.reshape(panels, -1).sum(axis=1))])
            inside = np.concatenate([[0.0], np.cumsum((w * values * np.exp(t / tau)).reshape(panels, -1).sum(axis=1))])
            panel = np.repeat(np.arange(panels), len(_X))
            width = t - edges[panel]
            inner = edges[panel][:, None] + width[:, None] * _X
            fine = rate(k, inner.ravel()).reshape(inner.shape) * np.exp(inner / tau)
            upto = inside[panel] + width * (fine @ _W)
            own.append(2.0 * (w @ (values * np.exp(-t / tau) * upto)))
        apart = np.maximum(a[None, :] - b[:, None], 0.0)
        later = np.triu(np.outer(late, early) * np.exp(-apart / tau), 1)
        return later + later.T + np.diag(own)

    def dense(self) -> dict[str, float]:
        """Standard deviations of all parameters by dense generalised least squares with priors."""
        columns = self.columns()
        stds = np.array([self.prior_of(name) for name in columns])
        prior = np.diag(1.0 / stds)
        found = dense_gls(np.array(list(columns.values())).T, self.covariance(), prior)
        return dict(zip(columns, found, strict=True))

    def prior_of(self, name: str) -> float:
        """Standard deviation that a parameter has beforehand: the longest family its name begins with."""
        symbol = name.split(".")[-1]
        kind = "gyro " if name.startswith("gyro") else "force " if name.startswith("acc") else ""
        families = [f for f in self.scene.priors if (kind + symbol).startswith(f)]
        return self.scene.priors[max(families, key=len)]


def _gauss_markov(a: np.ndarray, b: np.ndarray, tau: float) -> np.ndarray:
    """`∫∫exp(−|t − s|/τ)` over pairs of intervals that are the same, or do not overlap."""
    x = (b - a) / tau
    decayed = -np.expm1(-x)
    gap = np.maximum(np.maximum(a[None, :] - b[:, None], a[:, None] - b[None, :]), 0.0)
    apart = tau**2 * np.outer(decayed, decayed) * np.exp(-gap / tau)
    with np.errstate(all="ignore"):
        small_x = tau**2 * x**2 * (1.0 - x / 3.0 + x**2 / 12.0 - x**3 / 60.0 + x**4 / 360.0 - x**5 / 2520.0)
    same = np.where(x < 0.02, small_x, 2.0 * tau**2 * (x + np.expm1(-x)))
    return np.where(a[:, None] == a[None, :], same[:, None], apart)
