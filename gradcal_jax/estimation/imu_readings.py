"""What a whole unit reads by its parameters, on a table with errors of its own: the forward model of the estimate.

Finite geometry, with the errors of base, axes, mounting and encoders, and sensors that multiply what they sense; the
channels' terms are evaluated at the resulting signals.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.estimation.executed_nodes import NO_ERRORS, AngleErrors, PieceCourse, courses_of, nodes_of_rows
from gradcal_jax.estimation.gyro_stops import across_stops
from gradcal_jax.estimation.imu_rows import ExecutedImu, ImuRows
from gradcal_jax.information import (
    NoiseSteps,
    Posterior,
    encoder_rows,
    imu_system,
    readings_of_standstills,
    row_of_steps,
    rows_of_angles,
    segments_of,
    whitener,
)
from gradcal_jax.information.gears import errors_of_angles
from gradcal_jax.information.imu_rows import Segments
from gradcal_jax.model import (
    AxisHarmonics,
    BaseTilt,
    BodyNodes,
    ChannelKind,
    CommonScale,
    ImuModel,
    MountingError,
    NonOrthogonality,
)
from gradcal_jax.model.build import gears_of
from gradcal_jax.motion import Geometry, rotation
from gradcal_jax.spec.spec_sections import Spec

# Readings of one standstill differ by less, rad.
_TURNS = np.radians(1.0)
# Share of an angle's error in a gyro's row from which on it is along the axis; and the share of the white noise of a
# second below which angle errors in rows of gyros across it, by their misalignments, are neglected.
_ALONG, _ACROSS = 0.1, 0.2
# Step of finite differences, rad.
_SMALL_TURN = 1e-5
# The readings of a standstill begin and end within this share of the time between readings.
_LATE_READING = 0.5
# Of an IMU from the axes, m: a standard deviation.
_LONGEST_ARM = 0.3


class Installed(NamedTuple):
    """Estimated table: its geometry, the errors of its encoders, and the relative clock error that a kind of channel
    sees."""

    geometry: Geometry
    error_of: AngleErrors
    clock: dict[ChannelKind, float]


def installed(geometry: Geometry, model: ImuModel, values: np.ndarray) -> Installed:
    """The table with the installation's errors `values` (SI, in the model's order) as finite rotations.

    A non-orthogonality between two axes rotates all stages inside it: `E·Rot(e, θ) = Rot(E e, θ)·E`.
    """
    base, axes, mountings, gravity = geometry.base, geometry.axes.copy(), geometry.mountings.copy(), geometry.gravity
    waves: list[tuple[int, int, float, float]] = []
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
            waves += [
                (term.axis, n, float(a), float(b)) for n, a, b in zip(term.orders, *own.reshape(-1, 2).T, strict=True)
            ]
        elif isinstance(term, CommonScale):
            if term.of == "gravity":
                gravity = gravity + own[0]
            else:
                clock = {"gyro": float(own[0]), "accelerometer": float(own[0]) * term.forces}
        else:
            raise TypeError(f"terms of class {type(term).__name__} do not support finite angles")

    changed = eqx.tree_at(
        lambda g: (g.base, g.axes, g.mountings, g.gravity), geometry, (base, axes, mountings, np.asarray(gravity))
    )
    return Installed(changed, AngleErrors(tuple(waves)), clock)


def _small(vector: np.ndarray) -> np.ndarray:
    size = float(np.linalg.norm(vector))
    return np.eye(3) if size == 0.0 else rotation(vector / size, np.asarray(size))


class ImuReadings(NamedTuple):
    """A unit's readings, for comparison with any table: `observed` `(R,)`, integrals in rad and m/s; `added` `(P, 3)`,
    the mean specific force beyond gravity over every piece, in the frame of the innermost axis, m/s², if known; `free`:
    no encoder tells the angles of standstills, whose wide noise then absorbs a reading each; `common` `(R, k)`: changes
    of the readings by one standard deviation of each error that is neither a parameter nor a state of the noise.
    `courses` of the motion at these temperatures; `known`: what has been expected of them before; `segments` of the
    motion; `row` `(N,)`: the row that each step of the noise reads (−1: none).
    """

    model: ImuModel
    done: ExecutedImu
    segments: Segments
    row: np.ndarray
    log: ImuRows
    temperature_c: np.ndarray
    points: int
    observed: np.ndarray
    added: np.ndarray | None
    free: bool = False
    common: np.ndarray | None = None
    courses: Sequence[PieceCourse] = ()
    known: dict[tuple, np.ndarray] = {}  # noqa: RUF012

    def expected(self, parameters: np.ndarray, axis: int = -1, constant: float = 0.0, slope: float = 0.0) -> np.ndarray:
        """`h(β)` `(R,)` of the parameters in the engine's coordinates, with further errors of one axis's angles."""
        key = parameters.tobytes(), axis, constant, slope
        if key not in self.known:
            self.known[key] = self._expected(parameters, axis, constant, slope)
        return self.known[key]

    def _expected(self, parameters: np.ndarray, axis: int, constant: float, slope: float) -> np.ndarray:
        model = self.model
        table = installed(self.done.motion.geometry, model, parameters[model.calibrated :])
        error_of = table.error_of._replace(axis=axis, constant=constant, slope=slope)
        nodes = self._nodes(table.geometry, error_of, parameters)
        at = self.segments
        ideal = nodes.of_kinds(lambda g: g.integral(np.concatenate([g.rate, g.force], axis=-1)), (6,))
        result = np.zeros(len(at.row_segment))
        for i, (c, columns) in enumerate(zip(model.channels, model.own_columns(nodes), strict=True)):
            rows = at.row_channel == i
            output = ideal[nodes.kind, c.index] + columns @ parameters[model.where(c.kind, c.axis)]
            result[rows] = at.sums(output)[at.row_segment[rows]] * (1.0 + table.clock[c.kind])
        return result

    @property
    def angle_states(self) -> slice:
        """The noise states that are the errors of the axes' angles now."""
        begin = self.model.own_states
        return slice(begin, begin + self.done.motion.geometry.axis_count)

    def by_steps(self, values: np.ndarray) -> np.ndarray:
        """Values of the rows in the order of the noise steps; zero for steps within a segment, which have no row."""
        there = (self.row >= 0).reshape(-1, *(1,) * (values.ndim - 1))
        return np.where(there, values[self.row], np.zeros((), values.dtype))

    def left(self, parameters: np.ndarray) -> np.ndarray:
        """`(N,)`: by the noise steps, what the readings used are more than expected."""
        return self.by_steps(np.where(self.segments.used, self.observed - self.expected(parameters), 0.0))

    def whitener(self, steps: NoiseSteps) -> Callable[[np.ndarray], np.ndarray]:
        """The function from values `(N, k)` of the noise steps to rows of variance one, `(n, k)`, of the rows that are
        used."""
        used, white = self.by_steps(np.asarray(self.segments.used)), whitener(steps)
        if self.common is None:
            return lambda values: white(values)[used]
        # The root of the inverse of I + C Cᵀ.
        along, sizes, _ = np.linalg.svd(white(self.by_steps(self.common))[used], full_matrices=False)
        less = (1.0 - 1.0 / np.hypot(1.0, sizes))[:, None]

        def without_common(values: np.ndarray) -> np.ndarray:
            rows = white(values)[used]
            return rows - along @ (less * (along.T @ rows))

        return without_common

    def at(self, temperature_c: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """`h(β)` `(R,)` if the maps had other temperatures."""
        return self._with_temperature(temperature_c).expected(parameters)

    def _with_temperature(self, temperature_c: np.ndarray) -> "ImuReadings":
        courses = courses_of(self.done, self.log, self.points, temperature_c)
        return self._replace(temperature_c=temperature_c, courses=courses, known={})

    def with_common(self, errors: np.ndarray | None) -> "ImuReadings":
        """The same with further `common` errors `(R, k)`."""
        if errors is None:
            return self
        return self._replace(common=errors if self.common is None else np.concatenate([self.common, errors], axis=1))

    def of_shown_angles(self, before: np.ndarray, after: np.ndarray, about: np.ndarray | None = None) -> np.ndarray:
        """Derivatives `(R, k)` of the rows, rad or m/s, with respect to `k` errors of the angles that the table shows,
        of which one rad makes errors of `before` and `after`, `(P, L, k)`, at the ends of every piece; at the
        parameters `about` (None: of ideal sensors on an ideal table)."""
        nominal = about is None
        of_angles = encoder_rows(self.done.motion, self.model, self.nominal()) if nominal else self.by_angles(about)
        return rows_of_angles(self.segments, of_angles, before, after)

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
            return imu_system(motion, model, self.nominal())
        table = installed(motion.geometry, model, about[model.calibrated :])
        steps, columns = imu_system(motion, model, self._nodes(table.geometry, table.error_of, about))
        here = self.expected(about)
        for together in self._changed_together():
            there = about.copy()
            there[[place for place, _ in together]] += _SMALL_TURN
            changed = (self.expected(there) - here) / _SMALL_TURN
            for place, only in together:
                columns[:, place] = self.by_steps(np.where(only, changed, 0.0))
        return self._with_own_angles(steps, about, here), columns

    def _changed_together(self) -> Iterator[list[tuple[int, np.ndarray]]]:
        """Parameters whose derivatives depend on the others, with the rows that see them: those of a list have no row
        in common. They are the misalignments (what a sensor senses across its axis is multiplied by its scale factor:
        without this, a rotation of the body's frame, which misalignments can stand for, would seem to be observable
        over temperature) and the rotations of the installation."""
        model, at = self.model, self.segments
        own: dict[int, list[int]] = {}
        for number, _, places in model.misalignments():
            own.setdefault(number, []).extend(range(places.start, places.stop))
        for of_channels in zip_longest(*own.values()):
            pairs = zip(own, of_channels, strict=True)
            yield [(place, at.row_channel == number) for number, place in pairs if place is not None]
        hung, begin = self.done.motion.mounting[at.first][at.row_segment], model.calibrated
        for term in model.installation:
            if isinstance(term, MountingError):
                # Each row is of one mounting.
                for k in range(3):
                    yield [(begin + 3 * n + k, (hung == n) | (term.size == 3)) for n in range(term.size // 3)]
            elif isinstance(term, BaseTilt | NonOrthogonality):
                for k in range(term.size):
                    yield [(begin + k, np.ones(len(hung), bool))]
            begin += term.size

    def sees_angles(self, about: np.ndarray) -> tuple[bool, bool]:
        """Whether gyros across an axis, and accelerometers, see the errors of its angle by more than a part of their
        noise, at these parameters."""
        if self.done.motion.line.rates:
            return False, False
        values, encoder = np.abs(self.model.to_reported @ about), self.model.encoder
        angle = float(np.max(np.hypot(encoder.offset, encoder.reading)))

        def seen_by(kind: ChannelKind, names: str, each: float) -> bool:
            sizes = (v for name, v in zip(self.model.names(), values, strict=True) if re.match(names, name))
            quiet = [float(c.angle_random_walk) for c in self.model.channels if c.kind == kind]
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
        motion, at = self.done.motion, self.segments
        rotated, tilted = self.sees_angles(about)
        if not (self.free or rotated or tilted):
            return steps
        kinds = np.array([c.kind == "gyro" for c in self.model.channels])
        gyros = self.by_steps(kinds[at.row_channel] & rotated)
        forces = self.by_steps(~kinds[at.row_channel] & tilted)
        by_angles, axes = self.by_angles(about, here), motion.geometry.axis_count
        observation = np.array(steps.observation)
        for place, own in enumerate(by_angles.reshape(len(by_angles), 2 * axes).T):
            state = self.angle_states.start + place
            nominal = observation[:, state]
            needed = self.free | (gyros & (np.abs(nominal) < _ALONG)) | forces
            observation[:, state] = np.where(needed, self.by_steps(own), nominal)
        return steps._replace(observation=observation)

    def by_angles(self, about: np.ndarray, here: np.ndarray | None = None) -> np.ndarray:
        """The derivatives `(R, 2, L)` of the rows with respect to errors of the axes' angles at the end and at the
        begin of their segments, at these parameters. `here`: what is expected there, if it is known."""
        motion, at = self.done.motion, self.segments
        before, after = motion.angles()
        here = self.expected(about) if here is None else here
        found: list[np.ndarray] = []
        for k in range(motion.geometry.axis_count):
            by_constant, by_slope = (
                (self.expected(about, k, **of) - here) / _SMALL_TURN
                for of in ({"constant": _SMALL_TURN}, {"slope": _SMALL_TURN})
            )
            begin, end = (a[at.row_segment, k] for a in (before[at.first], after[at.last]))
            way = end - begin
            turns = np.abs(way) > _TURNS
            whole = np.where(turns, way, 1.0)
            of_end = np.where(turns, (by_slope - begin * by_constant) / whole, by_constant)
            found.append(np.stack([of_end, np.where(turns, (end * by_constant - by_slope) / whole, 0.0)], axis=1))
        return np.stack(found, axis=2)

    def _nodes(
        self, geometry: Geometry, errors: AngleErrors = NO_ERRORS, parameters: np.ndarray | None = None
    ) -> BodyNodes:
        """The nodes on a table of this geometry, for sensors with the misalignments of `parameters`."""
        nodes = nodes_of_rows(self.done, geometry, self.courses, self.temperature_c, errors, self.added)
        return nodes if parameters is None else self.model.with_misalignments(nodes, parameters)


def readings_of(
    model: ImuModel,
    done: ExecutedImu,
    log: ImuRows,
    temperature_c: np.ndarray,
    points: int,
    felt: np.ndarray | None = None,
    corrected_by: tuple[np.ndarray, Posterior] | None = None,
    *,
    free: bool = False,
) -> ImuReadings:
    """Integrals of every channel over its segments. `felt` `(n, 3)`: specific force at the rows, m/s², corrected by
    the parameters `corrected_by`, of which the posterior is given, too."""
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
    rest = log, temperature_c, points, np.where(at.used, observed, 0.0), None
    readings = ImuReadings(model, done, at, row_of_steps(done.motion, model), *rest, free=free)
    readings = readings._with_temperature(temperature_c)
    if felt is not None and corrected_by is not None:
        readings = readings._replace(added=_beyond_gravity(readings, felt, *corrected_by), known={})
    if model.encoder.held or done.motion.line.rates:
        return readings
    # The motion is that of the mean angles; the reference is each reading.
    before, after = done.motion.angles()
    read = _angles_read(log, done.rows, np.concatenate([before[:1], after]))
    apart = np.stack([read[at.last + 1] - after[at.last], read[at.first] - before[at.first]], axis=1)
    shown = np.sum(encoder_rows(done.motion, model, readings.nominal()) * apart[at.row_segment], axis=(1, 2))
    return readings._replace(observed=np.where(at.used, observed - shown, 0.0))


def readings_counted(done: ExecutedImu, model: ImuModel) -> ExecutedImu:
    """The motion of a table that is held, with the share of the readings of each standstill that were made: an axis is
    read before and after the gyros see that it stands, and a reading may be missing."""
    if not done.averaged or not model.encoder.held:
        return done
    motion, share = done.motion, np.ones(len(done.motion.axis))
    last, expected = segments_of(motion, model).last, readings_of_standstills(motion, model)[1:].T
    for k, (made, of_segments) in enumerate(zip(done.averaged, expected, strict=True)):
        moves = np.flatnonzero(np.asarray(motion.axis) == k)
        # Readings that are nearer to each other than those of the spec are not independent.
        planned = of_segments[np.searchsorted(last, moves)]
        independent = np.floor(made[:, 1] / model.encoder.every[k] + _LATE_READING) + 1.0
        share[moves] = np.minimum(made[:, 0], np.maximum(independent, planned)) / planned
    return done._replace(motion=eqx.tree_at(lambda m: m.line.share, motion, share))


def _beyond_gravity(readings: ImuReadings, felt: np.ndarray, parameters: np.ndarray, known: Posterior) -> np.ndarray:
    """`(P, 3)`: what the moves added to gravity, m/s², on average over every piece, in the frame of the innermost axis;
    zero where it is unknown.

    In that frame it does not depend on the body's. Kept in the body, it would hold the body's frame to the one of the
    `parameters` that corrected `felt`: gyros that are sensitive to it would seem to tell how the body is mounted.

    A plan may leave the bias of accelerometers poorly known, and with it what they tell of a move: 10 mg of it add
    0.5 deg/h to the rate of gyros of 50 deg/h/g. A slow turn adds next to nothing. So what is measured counts by the
    share of what a turn can add, the lever arm times the mean squared rate, in the sum of both variances.
    """
    done, log = readings.done, readings.log
    step, lost = np.diff(log.time_s, prepend=log.time_s[0]), ~np.isfinite(felt)
    total, missing = (np.cumsum(x, axis=0)[done.rows] for x in (np.where(lost, 0.0, felt) * step[:, None], lost))
    lasting = np.diff(log.time_s[done.rows])[:, None]
    table = installed(done.motion.geometry, readings.model, parameters[readings.model.calibrated :])
    nodes = readings._nodes(table.geometry, table.error_of)
    gravity = nodes.of_kinds(lambda g: g.integral(g.force), (3,))[nodes.kind]
    squared_rate = nodes.of_kinds(lambda g: g.integral(np.sum(g.rate**2, axis=-1)), ())[nodes.kind]
    measured = (np.diff(missing, axis=0) == 0) & (lasting > 0.0)
    possible = (_LONGEST_ARM * squared_rate[:, None]) ** 2
    unsure = np.where(measured, _variances_of_force(readings.model, nodes, known), 1.0)
    share = possible / (possible + unsure) / np.where(lasting > 0.0, lasting, 1.0)
    beyond = np.where(measured, (np.diff(total, axis=0) - gravity) * share, 0.0)
    return np.einsum("pij,pj->pi", table.geometry.mountings[done.motion.mounting], beyond)


def _variances_of_force(model: ImuModel, nodes: BodyNodes, known: Posterior) -> np.ndarray:
    """`(P, 3)`: of the integral of the specific force over every piece, (m/s)², corrected by parameters of which so
    much is known; infinite where they are not observable."""
    result = np.zeros((len(nodes.kind), 3))
    for c in (c for c in model.channels if c.kind == "accelerometer"):
        own, view = model.where(c.kind, c.axis), nodes.sensed_by(c.kind, c.axis)
        columns = np.concatenate([term.columns(view) for term in c.terms], axis=1)
        result[:, c.axis] = Posterior(known.spread[own], known.hidden[own]).deviations(columns) ** 2
    return result


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


def errors_of_gears(spec: Spec, readings: ImuReadings, about: np.ndarray | None) -> np.ndarray | None:
    """Changes of the readings `(R, k)` by one standard deviation of each, of sensors with the parameters `about` (None:
    ideal ones); None without any. (An angle of a milliradian shows misalignments of per cents.)"""
    if not (errors := errors_of_angles(readings.done.motion, gears_of(spec))):
        return None
    before, after = np.stack([error for _, error in errors], axis=-1)
    return readings.of_shown_angles(before, after, about)
