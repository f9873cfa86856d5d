"""The estimate of a whole unit: Gauss–Newton with the constant Jacobian and noise of the prediction.

The readings are not linear in all parameters: the effect of a sensor's error depends on the true attitude of the table.
So the forward model uses finite geometry, with the estimated errors of base, axes, mounting and encoders, and evaluates
the channels' terms at the resulting signals:

    r = y − h(β),    δ = argmin |W r − W J δ|² + |P (β + δ)|²,    β ← β + δ

with the whitened Jacobian `W J` at the nominal installation or at a first estimate. Each step reduces the error by a
factor of about the installation's error: 1 mrad gains three digits a step. Where h is curved between that point and the
estimate, by more than a part of the noise, J is taken again about the estimate: a rotation of the body's frame is seen
by products of small errors alone (`M(T) δ`), so that an estimate with the first J stops where it says nothing.

**Robust**: readings that the model cannot explain (an encoder's slip, a reading taken too early) get a lower weight, by
Huber's function on the normalised innovations `r_k`: `w = min(1, k/|r|)`, k = 2.5 by default (the efficiency on clean
data stays above 99 %). A weight acts on the *reading*, whose variance becomes `R + (1/w − 1) S`, S the variance of its
innovation, and all rows are whitened again: a lower weight of the whitened row alone would leave the effect of the bad
reading in the filter's state and so in the next innovations. A jump of the integrated rate persists and shows as
several bad readings in a row: it is reported, but only the data can be corrected.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.estimation.executed_nodes import nodes_of_rows
from gradcal_jax.estimation.imu_executed import ExecutedImu, ImuRows, across_stops
from gradcal_jax.estimation.solve import Estimate, Whitened, factored
from gradcal_jax.information import (
    NoiseSteps,
    Posterior,
    encoder_rows,
    estimator_of_means,
    filter_readings,
    filtered_states,
    imu_system,
    imu_unweighted,
    row_of_steps,
    segments_of,
    whiten,
)
from gradcal_jax.model import (
    AxisHarmonics,
    BaseTilt,
    BodyNodes,
    ChannelKind,
    CommonScale,
    ImuModel,
    MountingError,
    NonOrthogonality,
    Term,
)
from gradcal_jax.trajectory import Geometry, rotation

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
HUBER = 2.5
# Largest number of weighings, and the change of a weight at which they end.
_WEIGHINGS, _NO_CHANGE = 20, 0.01
# Readings of one standstill differ by less, rad.
_TURNS = np.radians(1.0)
# Share of an angle's error in a gyro's row from which on it is along the axis; and the share of the white noise of a
# second below which angle errors in rows of gyros across it, by their misalignments, are neglected.
_ALONG, _ACROSS = 0.1, 0.2
# Step of finite differences, rad.
_SMALL_TURN = 1e-5
# Least part of an encoder's error in the row of a gyro that is along its axis.
_SEES_ENCODER = 0.5
# Factor by which the angles' noise is narrowed to see which readings it absorbs, and the least part that counts.
_NARROWER, _ABSORBED = 0.5, 1e-6


# Of an axis and its angles (rad): their errors, and the derivatives of these.
AngleError = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Installed(NamedTuple):
    """Estimated table: `error_of(axis, angle)`: encoder error and derivative, rad; `clock`: relative clock error
    that a kind of channel sees."""

    geometry: Geometry
    error_of: AngleError | None
    clock: dict[ChannelKind, float]


def installed(geometry: Geometry, model: ImuModel, values: np.ndarray) -> Installed:
    """The table with the installation's errors `values` (SI, in the model's order) as finite rotations.

    A non-orthogonality between two axes rotates all stages inside it: `E·Rot(e, θ) = Rot(E e, θ)·E`.
    """
    base, axes, mountings, gravity = geometry.base, geometry.axes.copy(), geometry.mountings.copy(), geometry.gravity
    waves: list[tuple[AxisHarmonics, np.ndarray]] = []
    clock: dict[ChannelKind, float] = {"gyro": 0.0, "accelerometer": 0.0}
    begin = 0
    for term in model.installation:
        own = np.asarray(values[begin : begin + term.size])
        begin += term.size
        if isinstance(term, BaseTilt):
            base = _small(own) @ base
        elif isinstance(term, NonOrthogonality):
            inside = np.eye(3)
            for l, angle in enumerate(own):
                inside = inside @ _small(angle * np.cross(geometry.axes[l + 1], geometry.axes[l]))
                axes[l + 1] = inside @ geometry.axes[l + 1]
            mountings = inside @ mountings
        elif isinstance(term, MountingError):
            mountings = mountings @ np.stack([_small(own[3 * k : 3 * k + 3]) for k in range(len(mountings))])
        elif isinstance(term, AxisHarmonics):
            waves.append((term, own))
        elif isinstance(term, CommonScale):
            if term.of == "gravity":
                gravity = gravity + own[0]
            else:
                clock = {"gyro": float(own[0]), "accelerometer": float(own[0]) * term.forces}
        else:
            raise TypeError(f"{type(term).__name__} has no form for finite angles")

    def error_of(axis: int, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error, slope = np.zeros(angle.shape), np.zeros(angle.shape)
        for term, own in waves:
            if term.axis == axis:
                for k, order in enumerate(term.orders):
                    c, s = np.cos(order * angle), np.sin(order * angle)
                    error += own[2 * k] * c + own[2 * k + 1] * s
                    slope += order * (own[2 * k + 1] * c - own[2 * k] * s)
        return error, slope

    changed = eqx.tree_at(
        lambda g: (g.base, g.axes, g.mountings, g.gravity), geometry, (base, axes, mountings, np.asarray(gravity))
    )
    return Installed(changed, error_of if waves else None, clock)


def _small(vector: np.ndarray) -> np.ndarray:
    size = float(np.linalg.norm(vector))
    return np.eye(3) if size == 0.0 else rotation(vector / size, np.asarray(size))


class ImuReadings(NamedTuple):
    """A unit's readings, for comparison with any table: `observed` `(R,)`, integrals in rad and m/s; `added` `(P, 3)`,
    the mean specific force beyond gravity over every piece, in the frame of the innermost axis, m/s², if known; `sigma`
    `(R,)`: standard deviations, in the place of the model's noise of the channels (None: the model's); `free`: no
    encoder tells the angles of standstills, whose wide noise then absorbs a reading each.
    """

    model: ImuModel
    done: ExecutedImu
    log: ImuRows
    temperature_c: np.ndarray
    points: int
    observed: np.ndarray
    added: np.ndarray | None
    sigma: np.ndarray | None = None
    free: bool = False

    def expected(self, parameters: np.ndarray, error_of: AngleError | None = None) -> np.ndarray:
        """`h(β)` `(R,)` of the parameters in the engine's coordinates; `error_of`: of the axes' angles, in the place of
        the installation's."""
        model = self.model
        table = installed(self.done.motion.geometry, model, parameters[model.calibrated :])
        nodes = self._nodes(table.geometry, error_of or table.error_of)
        at = segments_of(self.done.motion, model)
        ideal = nodes.integrals(lambda g: g.integral(np.concatenate([g.rate, g.force], axis=-1)), (6,))
        result, begin = np.zeros(len(at.row_segment)), 0
        for i, (c, columns) in enumerate(zip(model.channels, model.own_columns(nodes), strict=True)):
            own = parameters[begin : begin + c.model.size]
            begin += c.model.size
            output = ideal[nodes.kind, c.index] + columns @ own
            rows = at.row_channel == i
            result[rows] = at.sums(output)[at.row_segment[rows]] * (1.0 + table.clock[c.kind])
        return result

    @property
    def angle_states(self) -> slice:
        """The noise states that are the errors of the axes' angles now."""
        begin = self.model.own_states
        return slice(begin, begin + self.done.motion.geometry.axis_count)

    def by_steps(self, values: np.ndarray) -> np.ndarray:
        """Values of the rows in the order of the noise steps; zero for steps within a segment, which have no row."""
        row = row_of_steps(self.done.motion, self.model)
        return np.where(row >= 0, values[row], np.zeros((), values.dtype))

    def whitened_term(self, channel: int, term: Term) -> np.ndarray:
        """The whitened columns `(n, k)` of a term, of the rows used, if the channel of this number had it."""
        steps, _ = self.linear(None)
        nodes, at = self.nominal(), segments_of(self.done.motion, self.model)
        of = self.model.channels[channel]
        alone = eqx.tree_at(lambda m: m.terms, of.model, (term,))
        (columns,) = ImuModel((replace(of, model=alone),), (), self.model.encoder).own_columns(nodes)
        rows = np.zeros((len(at.row_segment), term.size))
        own = at.row_channel == channel
        rows[own] = at.sums(np.asarray(columns))[at.row_segment[own]]
        row = row_of_steps(self.done.motion, self.model)
        white = np.asarray(whiten(steps, np.where((row >= 0)[:, None], rows[row], 0.0)))
        return white[self.by_steps(np.asarray(at.used))]

    def with_noise(self, steps: NoiseSteps, variance: np.ndarray) -> NoiseSteps:
        """The steps with more noise of their readings, `(N,)`: where the only axis of a table is read, of its encoder,
        which the next row contains, too."""
        line, axes = self.done.motion.line, self.done.motion.geometry.axis_count
        if axes > 1 or self.model.encoder.held or line.rates:
            return steps._replace(reading_variance=steps.reading_variance + variance)
        now = self.model.own_states
        stays = np.zeros(len(variance), bool) if steps.stays is None else np.asarray(steps.stays)
        along = np.asarray(steps.observation)[:, now]
        of_encoder = ~stays & (np.abs(along) > _SEES_ENCODER)
        covariance = np.array(steps.covariance)
        covariance[of_encoder, now, now] += variance[of_encoder] / along[of_encoder] ** 2
        of_row = steps.reading_variance + np.where(of_encoder, 0.0, variance)
        return steps._replace(covariance=covariance, reading_variance=of_row)

    def nominal(self) -> BodyNodes:
        """The nodes of the nominal table."""
        return self._nodes(self.done.motion.geometry)

    def linear(self, about: np.ndarray | None) -> tuple[NoiseSteps, np.ndarray]:
        """Noise steps, and the readings' derivatives with respect to the parameters `(R, p)` at `about`; None: nominal.

        A rotation of the table reaches a channel through the channel's own errors. For a poorly known rotation (of a
        mounting, which resembles misalignments) this effect exceeds the errors' uncertainty over temperature.
        """
        motion, model = self.done.motion, self.model
        if about is None:
            return self._system(self.nominal())
        table = installed(motion.geometry, model, about[model.calibrated :])
        steps, columns = self._system(self._nodes(table.geometry, table.error_of))
        here, begin = self.expected(about), model.calibrated
        for term in model.installation:
            if isinstance(term, BaseTilt | NonOrthogonality | MountingError):
                for k in range(begin, begin + term.size):
                    there = about + _SMALL_TURN * np.eye(model.size)[k]
                    columns[:, k] = self.by_steps((self.expected(there) - here) / _SMALL_TURN)
            begin += term.size
        return self._with_own_angles(steps, about, here), columns

    def sees_angles(self, about: np.ndarray) -> tuple[bool, bool]:
        """Whether gyros across an axis, and accelerometers, see the errors of its angle by more than a part of their
        noise, at these parameters."""
        if self.done.motion.line.rates:
            return False, False
        values, encoder = np.abs(self.model.to_reported @ about), self.model.encoder
        angle = float(np.max(np.hypot(encoder.offset, encoder.reading)))

        def seen_by(kind: ChannelKind, names: str, each: float) -> bool:
            sizes = (v for name, v in zip(self.model.names(), values, strict=True) if re.match(names, name))
            quiet = [float(c.model.angle_random_walk) for c in self.model.channels if c.kind == kind]
            return max(sizes, default=0.0) * angle * each > _ACROSS * min(quiet, default=np.inf)

        gravity = float(self.done.motion.geometry.gravity)
        rotated = seen_by("gyro", r"gyro_.\.m_", 1.0)
        return rotated, seen_by("accelerometer", r"accelerometer_.\.m_|mounting", gravity)

    def _with_own_angles(self, steps: NoiseSteps, about: np.ndarray, here: np.ndarray) -> NoiseSteps:
        """The steps with the readings' derivatives by the errors of angles as the channels' own errors make them, where
        these derivatives are needed.

        Without an encoder that is everywhere, as for the installation: else a tilt about an axis, which resembles them,
        would seem to be observable. Otherwise only gyros across the axis and accelerometers, which see its angle by
        their misalignments or the mounting's error, would have too small a noise. A constant error is that of both
        standstills, one in proportion to the angle that of each by its own angle."""
        motion, at = self.done.motion, segments_of(self.done.motion, self.model)
        rotated, tilted = self.sees_angles(about)
        if not (self.free or rotated or tilted):
            return steps
        kinds = np.array([c.kind == "gyro" for c in self.model.channels])
        gyros = self.by_steps(kinds[at.row_channel] & rotated)
        forces = self.by_steps(~kinds[at.row_channel] & tilted)
        before, after = motion.angles()
        observation = np.array(steps.observation)
        for k in range(motion.geometry.axis_count):
            now = self.angle_states.start + k
            by: list[np.ndarray] = []
            for slope in (0.0, 1.0):

                def error_of(axis: int, angle: np.ndarray, k: int = k, slope: float = slope):
                    size = _SMALL_TURN * (axis == k)
                    return size * (angle * slope + 1.0 - slope), np.full(angle.shape, size * slope)

                by.append((self.expected(about, error_of) - here) / _SMALL_TURN)
            begin, end = (a[at.row_segment, k] for a in (before[at.first], after[at.last]))
            way = end - begin
            turns = np.abs(way) > _TURNS
            whole = np.where(turns, way, 1.0)
            of_end = np.where(turns, (by[1] - begin * by[0]) / whole, by[0])
            of_begin = np.where(turns, (end * by[0] - by[1]) / whole, 0.0)
            for state, own in ((now, of_end), (now + motion.geometry.axis_count, of_begin)):
                nominal = observation[:, state]
                needed = self.free | (gyros & (np.abs(nominal) < _ALONG)) | forces
                observation[:, state] = np.where(needed, self.by_steps(own), nominal)
        return steps._replace(observation=observation)

    def _system(self, nodes: BodyNodes) -> tuple[NoiseSteps, np.ndarray]:
        steps, columns = imu_system(self.done.motion, self.model, nodes)
        if self.sigma is None:
            return steps, columns
        # What follows the channels' integrals and processes are errors of the reference.
        own = slice(self.model.own_states)
        transition, covariance, initial = (np.array(x) for x in (steps.transition, steps.covariance, steps.initial))
        transition[:, own], covariance[:, own, own], initial[own, own] = 0.0, 0.0, 0.0
        variance = steps.reading_variance + self.by_steps(self.sigma) ** 2
        own_noise = {"transition": transition, "covariance": covariance, "initial": initial}
        return steps._replace(reading_variance=variance, **own_noise), columns

    def _nodes(self, geometry: Geometry, error_of=None) -> BodyNodes:
        others = self.log.others(self.model.others, self.temperature_c)
        at = self.done, self.log, geometry, self.points, self.temperature_c
        return nodes_of_rows(*at, error_of, self.added, others)


def readings_of(
    model: ImuModel,
    done: ExecutedImu,
    log: ImuRows,
    temperature_c: np.ndarray,
    points: int,
    felt: np.ndarray | None = None,
    corrected_by: np.ndarray | None = None,
    *,
    free: bool = False,
) -> ImuReadings:
    """Integrals of every channel over its segments. `felt` `(n, 3)`: specific force at the rows, m/s², corrected by
    the parameters `corrected_by`."""
    at = segments_of(done.motion, model)
    step = np.diff(log.time_s, prepend=log.time_s[0])
    first, last = done.rows[at.first], done.rows[at.last + 1]
    observed, shared = np.zeros(len(at.row_segment)), across_stops(done, log)
    for i, c in enumerate(model.channels):
        values = (log.rates if c.kind == "gyro" else log.force)[:, c.axis]
        total = np.cumsum(np.where(np.isfinite(values), values, 0.0) * step)
        whole = total[last] - total[first]
        if c.kind == "gyro":
            whole = whole + np.add.reduceat(shared[:, c.axis], at.first)
        rows = at.row_channel == i
        observed[rows] = whole[at.row_segment[rows]]
    readings = ImuReadings(model, done, log, temperature_c, points, np.where(at.used, observed, 0.0), None, free=free)
    if felt is not None and corrected_by is not None:
        readings = readings._replace(added=_beyond_gravity(readings, felt, corrected_by))
    if model.encoder.held or done.motion.line.rates:
        return readings
    # The motion is that of the mean angles; the reference is each reading.
    before, after = done.motion.angles()
    read = _angles_read(log, done.rows, np.concatenate([before[:1], after]))
    apart = np.stack([read[at.last + 1] - after[at.last], read[at.first] - before[at.first]], axis=1)
    shown = np.sum(encoder_rows(done.motion, model, readings.nominal()) * apart[at.row_segment], axis=(1, 2))
    return readings._replace(observed=np.where(at.used, observed - shown, 0.0))


def _beyond_gravity(readings: ImuReadings, felt: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """`(P, 3)`: what the moves added to gravity, m/s², on average over every piece, in the frame of the innermost axis;
    zero where it is unknown.

    In that frame it does not depend on the body's. Kept in the body, it would hold the body's frame to the one of the
    `parameters` that corrected `felt`: gyros that are sensitive to it would seem to tell how the body is mounted.
    """
    done, log = readings.done, readings.log
    step, lost = np.diff(log.time_s, prepend=log.time_s[0]), ~np.isfinite(felt)
    total, missing = (np.cumsum(x, axis=0)[done.rows] for x in (np.where(lost, 0.0, felt) * step[:, None], lost))
    lasting = np.diff(log.time_s[done.rows])[:, None]
    table = installed(done.motion.geometry, readings.model, parameters[readings.model.calibrated :])
    nodes = readings._nodes(table.geometry, table.error_of)
    gravity = nodes.integrals(lambda g: g.integral(g.force), (3,))[nodes.kind]
    known = (np.diff(missing, axis=0) == 0) & (lasting > 0.0)
    beyond = np.where(known, (np.diff(total, axis=0) - gravity) / np.where(lasting > 0.0, lasting, 1.0), 0.0)
    return np.einsum("pij,pj->pi", table.geometry.mountings[done.motion.mounting], beyond)


def _angles_read(log: ImuRows, rows: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """The angles (rad) that were read at rows of the log, or nearest to them in the same standstill of the axis, of
    which the motion has the angles `moved`, `(P + 1, L)`."""
    result = np.empty_like(moved)
    for axis, angles in enumerate(log.angles.T):
        known = np.flatnonzero(np.isfinite(angles))
        if not len(known):
            result[:, axis] = moved[:, axis]
            continue
        after = np.clip(np.searchsorted(log.time_s[known], log.time_s[rows]), 0, len(known) - 1)
        before = np.maximum(after - 1, 0)
        nearer = log.time_s[rows] - log.time_s[known[before]] < log.time_s[known[after]] - log.time_s[rows]
        apart = [np.abs(angles[known[place]] - moved[:, axis]) for place in (before, after)]
        turns = np.abs(apart[0] - apart[1]) > _TURNS
        result[:, axis] = angles[known[np.where(np.where(turns, apart[0] < apart[1], nearer), before, after)]]
    return result


class ImuEstimate(NamedTuple):
    """One unit's `estimate`, and its `white` rows, linearised about it, for those of the `R` rows that are
    `used`. `taken`: the same rows of an orthonormal basis of the fitted columns. `moved`: size of the last of the
    `rounds`, in standard deviations. `weights`: of the rows used, 1 for full weight; `channel`: of each of
    them, its number. `curved`: norm of what the whitened residuals differ from linear ones by.
    """

    estimate: Estimate
    white: Whitened
    used: np.ndarray
    taken: np.ndarray
    moved: float
    rounds: int
    weights: np.ndarray
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


def solve_imu(readings: ImuReadings, about: np.ndarray | None = None, *, threshold: float | None = None) -> ImuEstimate:
    """Parameters of a unit and its installation from its rows, with minimal norm in unobservable directions.

    `about`: approximate parameters in the engine's coordinates, the point of linearisation. `threshold`: rows with
    larger residuals, in standard deviations, get a lower weight; see the module's head. Errors: `ValueError` where no
    row is used, or one is not finite, and for a threshold that is not positive.
    """
    steps, columns = readings.linear(about)
    used = np.asarray(segments_of(readings.done.motion, readings.model).used)
    if not used.any():
        raise ValueError("no reading is left between two usable rows")
    if not np.isfinite(readings.observed[used]).all():
        raise ValueError("a used reading is not finite")
    estimate = _solved(readings, steps, columns, used, about)
    if about is not None:
        estimate, steps, columns = _linearised_again(readings, estimate, steps, columns, used, about)
    if threshold is None:
        return estimate

    if not threshold > 0.0:
        raise ValueError(f"the threshold of a robust estimate must be positive, not {threshold}")
    noise, kept = steps, readings.by_steps(used)
    extra, weights = np.zeros(len(kept)), np.ones(int(kept.sum()))
    for _ in range(_WEIGHINGS):
        spread = innovation_variance(noise)[kept]
        # The innovation relative to its variance without the increase.
        plain = spread - extra[kept]
        against = np.abs(estimate.estimate.residuals) * np.sqrt(spread / np.maximum(plain, np.finfo(float).tiny))
        new = np.minimum(1.0, threshold / np.maximum(against, threshold))
        if np.max(np.abs(new - weights)) < _NO_CHANGE:
            break
        weights = new
        extra[kept] = (1.0 / weights - 1.0) * plain
        noise = readings.with_noise(steps, extra)
        estimate = _solved(readings, noise, columns, used, estimate.parameters)
    return estimate._replace(weights=weights)


def _linearised_again(
    readings: ImuReadings,
    estimate: ImuEstimate,
    steps: NoiseSteps,
    columns: np.ndarray,
    used: np.ndarray,
    about: np.ndarray,
) -> tuple[ImuEstimate, NoiseSteps, np.ndarray]:
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
            return estimate._replace(moved=max(estimate.moved, change)), steps, columns
        steps, columns = readings.linear(at)
        estimate, about = _solved(readings, steps, columns, used, at), at
    return estimate, steps, columns


def innovation_variance(steps: NoiseSteps) -> np.ndarray:
    """`(N,)`: variance of each reading conditional on those before it, rad²; zero at steps without a reading."""
    none = np.zeros((len(steps.initial), 0)), np.zeros((len(steps.used), 0))
    per_std = filter_readings(none[0], steps.initial, steps, none[1]).per_std
    return np.divide(1.0, per_std**2, out=np.zeros(len(per_std)), where=per_std > 0.0)


def absorbed(steps: NoiseSteps, states: slice) -> np.ndarray:
    """`(N,)`: the part of every reading that the wide noise of the angles, at `states`, absorbs: by how much the
    logarithm of its variance grows with theirs, so that the parts add up to the number of angles."""
    n, per_std = steps.observation.shape[1], []
    for factor in (1.0, _NARROWER):
        scale = np.ones(n)
        scale[states] = factor
        both = scale[:, None] * scale
        of = steps._replace(covariance=steps.covariance * both, initial=steps.initial * both)
        per_std.append(filter_readings(np.zeros((n, 0)), of.initial, of, np.zeros((len(of.used), 0))).per_std)
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
    states = filtered_states(steps, apart)[:, readings.angle_states]
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
    estimator, own = estimator_of_means(motion, model, steps, columns), model.calibrated
    nothing = np.zeros(model.size)
    apart = readings.by_steps(np.where(at.used, readings.observed - readings.expected(nothing), 0.0))
    beta = np.append(estimator.back @ (estimator.weights.T @ apart), nothing[own:])
    rest = weighted.white.data - weighted.white.rows @ beta
    known = imu_unweighted(motion, model, readings.nominal())
    fitted = weighted.estimate._replace(parameters=beta, known=known, residuals=rest)
    return weighted._replace(estimate=fitted)


def _solved(
    readings: ImuReadings, steps: NoiseSteps, columns: np.ndarray, used: np.ndarray, about: np.ndarray | None
) -> ImuEstimate:
    """The estimate with these noise steps and derivatives `columns`, iterated from the parameters `about`."""
    model = readings.model
    kept = readings.by_steps(used)
    jacobian, prior = np.asarray(whiten(steps, columns))[kept], model.prior_rows()
    design = np.concatenate([jacobian, prior])
    of = factored(design)
    known = of.known
    deviation = known.deviations(np.eye(model.size))
    counted = np.isfinite(deviation) & (deviation > 0.0)
    beta, moved, rounds = np.zeros(model.size) if about is None else about.copy(), np.inf, 0

    def left_over(beta: np.ndarray) -> tuple[np.ndarray, float]:
        apart = readings.by_steps(np.where(used, readings.observed - readings.expected(beta), 0.0))
        rest = np.asarray(whiten(steps, apart[:, None]))[kept, 0]
        return rest, float(rest @ rest + np.sum((prior @ beta) ** 2))

    rest, squares = left_over(beta)
    first, begun, curved = rest, beta, 0.0
    while moved > _SETTLED and rounds < _ROUNDS and (about is None or curved < _BENT):
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
    return ImuEstimate(estimate, white, used, taken, moved, rounds, np.ones(len(rest)), channel, curved)
