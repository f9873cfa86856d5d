"""A spec in the core's terms: its channels, its installation, the motion of the table, and the IMUs of a fixture."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from gradcal_jax import model
from gradcal_jax import motion as trajectory
from gradcal_jax.information import (
    Posterior,
    SquareRootInformation,
    imu_information,
    imu_unweighted,
    posterior,
    segments_of,
)
from gradcal_jax.information.gears import gears_of, rows_of_gears
from gradcal_jax.model import (
    AXIS_NAMES,
    SECOND,
    Basis,
    BodyNodes,
    BSpline,
    Channel,
    ChannelKind,
    Discrepancy,
    GradientOfBias,
    GradientOfScale,
    HigherPolynomials,
    Hysteresis,
    ImuModel,
    Map,
    OtherTemperature,
    OwnTerm,
    PathTerm,
    Polynomial,
    ProductTerm,
    RotationSensitivity,
    SignalMap,
    TemperatureDifference,
    Term,
    own_term,
)
from gradcal_jax.model.build import (
    basis,
    gyro_channel,
    late_of,
    named_processes,
    or_infinite,
    processes_of,
    table_schedule,
)
from gradcal_jax.motion import Geometry, Schedule, TableMotion
from gradcal_jax.spec import sensor as sensor_file
from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.memory import too_large
from gradcal_jax.spec.motion_plan import PlanSchedule
from gradcal_jax.spec.places import specs_at_places
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.temperature_path import OwnError, PlayOfBias

# Names of terms, for requirements and sentences; a gyro's maps have the names of a single axis.
MISALIGNMENT = "misalignment_{}"
G_SENSITIVITY = "g_sensitivity_{}"
SPECIFIC_FORCE_BIAS = "bias"
SECOND_ORDER = "second_order"
HYSTERESIS = "hysteresis_{}K"
SCALE_FACTOR_HYSTERESIS = "scale_factor_hysteresis_{}K"
GRADIENT_OF_SCALE = "scale_factor_temperature_gradient"
DIFFERENCE = "thermometer_difference"
_CONSTANT = Polynomial(0, 0.0, 1.0)
_LAGGED = 16
_LAG_TIMES = 8.0
# Fastest wave of a body whose attitude matters, in cycles a turn: squares of the force's components, or harmonics times
# a direction.
_WAVES = 3
_FEWEST = 16
# Standard deviation of an angle that is known exactly, rad: far below any encoder's.
_EXACT = 1e-12
# Standard deviation (rad) of a standstill's angle that no encoder tells: unknown beside what gravity and the gyros say,
# and small enough for a covariance in double precision to hold 0.1 µrad beside it.
_UNKNOWN = 3.0
# Rounding of a move's rate, at the rate up to which accelerometers are read.
_SLACK = 1e-9


class BuiltImu(NamedTuple):
    """An IMU's spec in the core's terms. `motion`: of the plan. `points`: quadrature points along a piece for functions
    of temperature, which are smooth there (`rough`: not along the pieces of a log). `sources`: for each kind of channel
    the indices of its noise processes by the name of their error source. `about` `(p,)`: the parameters of an estimate,
    by which its errors act; None: an ideal sensor's. `gears`: see `gears.gears_of`, of what the spec itself names."""

    spec: Spec
    model: ImuModel
    motion: TableMotion
    points: int
    rough: bool
    sources: Mapping[ChannelKind, Mapping[str, tuple[int, ...]]]
    about: np.ndarray | None = None
    gears: Sequence[tuple[float, float]] = ()

    def body_nodes(self) -> BodyNodes:
        """The nodes on which the terms are integrated."""
        return trajectory.body_nodes(self.motion, self.points)


def build_imu(
    spec: Spec,
    change: Callable[[Schedule], Schedule] | None = None,
    like: BuiltImu | None = None,
) -> BuiltImu:
    """Model and motion of an IMU's spec. `change`: what the times and rates of the plan become. `like`: an IMU with the
    same plan and other error terms, whose motion serves if the terms need the same pieces. Errors: `MemoryError` for a
    plan with more readings than this machine can hold, `ValueError` for a fixture of several IMUs."""
    if spec.rig.table.place:
        raise ValueError(
            "the spec has a fixture of several IMUs, and only predict, optimise and estimate support fixtures; for "
            "other commands, write the mounting of one place as rig.table.mounting, and remove rig.table.place"
        )
    if too := too_large(spec):
        raise MemoryError(too)
    model_, sources = _model_and_sources(spec)
    bases = [t.temperature for t in model_.terms if isinstance(t, Map | SignalMap | Discrepancy)]
    degree = max(b.degree if isinstance(b, Polynomial | BSpline | HigherPolynomials) else 0 for b in bases)
    # A lagging unit's exponentials are no polynomials; a play is linear in T on each piece.
    own = any(isinstance(t, OwnTerm) for c in model_.channels for t in c.model.terms)
    exponential = spec.sensor.lag is not None or bool(_decays(model_)) or own
    points = max(degree + 1, _LAGGED if exponential else 2 if model_.knows_path else 1)
    rough = model_.knows_path or any(b.breaks for b in bases)
    if like is not None and _divisions(spec, model_, like) == _divisions(like.spec, like.model, like):
        return BuiltImu(spec, model_, like.motion, points, rough, sources, gears=like.gears)
    gears = gears_of(spec) if like is None else like.gears
    return BuiltImu(spec, model_, _motion(spec, model_, change), points, rough, sources, gears=gears)


def plan_schedule(spec: Spec) -> Schedule:
    """The schedule of a spec's plan."""
    return table_schedule(spec.schedule, spec)


def course_before(spec: Spec) -> np.ndarray | None:
    """Turning points of the temperature (°C) before the spec's plan."""
    before = () if isinstance(spec.plan, StandardPlan) else spec.plan.before
    return np.array([float(t) for t in before]) if before else None


def imu_posterior(built: BuiltImu) -> Posterior:
    """The posterior of a unit after its plan and the motions before it, by the estimator that the spec names."""
    if unweighted_estimator(built.spec):
        return imu_unweighted(built.motion, built.model, built.body_nodes())
    return posterior(information_with_gears([(built.motion, built.body_nodes())], built.model, built.gears))


def information_with_gears(
    motions: Sequence[tuple[TableMotion, BodyNodes]], of: ImuModel, gears: Sequence[tuple[float, float]]
) -> SquareRootInformation:
    """The information of motions of one table, whose gears' errors are unknown."""
    common = [rows_of_gears(motion, of, nodes, gears)[1] for motion, nodes in motions] if gears else ()
    return imu_information(motions, of, common)


def unweighted_estimator(spec: Spec) -> bool:
    """Whether the spec's estimator is ordinary least squares on the points' rates, as in the paper's figure."""
    return isinstance(spec.plan, StandardPlan) and spec.plan.estimator == "least squares"


def _model_and_sources(spec: Spec) -> tuple[ImuModel, dict[ChannelKind, dict[str, tuple[int, ...]]]]:
    sensor, channels = spec.sensor, []
    sources: dict[ChannelKind, dict[str, tuple[int, ...]]] = {}
    if (gyro := sensor.gyro) is not None:
        clock = 0.0 if has_common_clock(spec) else sensor.clock_error
        own = named_processes(gyro, clock=clock, earth_is_unknown=spec.rig.site.is_unknown)
        processes, sources["gyro"] = processes_of(own)
        channels += [
            Channel(
                gyro_channel(
                    gyro,
                    axis,
                    processes,
                    signals=[*_signal_maps(gyro, axis), *_rotation_terms(gyro)],
                    path=_path_terms(sensor, gyro, axis),
                ),
                "gyro",
                AXIS_NAMES.index(axis),
            )
            for axis in gyro.axes
        ]
    if (force := sensor.accelerometer) is not None:
        slow = 0.0 if force.read_on_moves_below is None else float(force.read_on_moves_below) * (1.0 + _SLACK)
        processes, sources["accelerometer"] = processes_of(named_processes(force))
        channels += [
            Channel(_accelerometer(sensor, force, axis, processes), "accelerometer", AXIS_NAMES.index(axis), slow)
            for axis in force.axes
        ]
    table, angles = spec.rig.table, [axis.angle for axis in spec.rig.table.axis]
    numbers = ("standstill_offset", "reading_noise", "read_every", "timing_error")
    offset, reading, every, timing = (np.array([float(getattr(a, name)) for a in angles]) for name in numbers)
    if table.by_gravity:
        offset, reading, every = np.full(len(angles), _UNKNOWN), np.zeros(len(angles)), np.full(len(angles), np.inf)
    rate = np.asarray(float(table.rate_accuracy or 0.0))
    held = table.standing == "held"
    encoder = model.EncoderNoise(offset, reading, every, held, timing, rate, held or bool(np.any(offset)))
    return ImuModel(tuple(channels), _installation(spec), encoder), sources


def has_common_clock(spec: Spec) -> bool:
    """Whether the sample clock is a parameter common to all channels; independent points each have their own."""
    return not isinstance(spec.plan, StandardPlan) or spec.plan.points == "one run"


def _installation(spec: Spec) -> tuple[model.InstallationTerm, ...]:
    table, site = spec.rig.table, spec.rig.site
    terms: list[model.InstallationTerm] = []
    if table.tilt or table.azimuth:
        # A zero prior would be no prior: an angle that is known exactly keeps a tiny one.
        stds = np.array([float(table.tilt)] * 2 + [float(table.azimuth)])
        terms.append(model.BaseTilt(np.maximum(stds, _EXACT)))
    if len(table.axis) > 1 and any(a.orthogonality for a in table.axis):
        stds = np.array([float(a.orthogonality) for a in table.axis[:-1]])
        terms.append(model.NonOrthogonality(np.maximum(stds, _EXACT), tuple(a.name for a in table.axis)))
    for k, axis in enumerate(table.axis):
        if harmonics := axis.angle.harmonics:
            stds = np.repeat(np.array([float(h.amplitude) for h in harmonics]), 2)
            terms.append(model.AxisHarmonics(stds, tuple(h.order for h in harmonics), k, axis.name))
    if spec.sensor.frame == "case":
        terms.append(model.MountingError(np.repeat(np.array([float(m.accuracy) for m in table.mounting]), 3)))
    if site.gravity_accuracy and spec.sensor.accelerometer is not None:
        terms.append(model.CommonScale(np.array([float(site.gravity_accuracy)]), "gravity"))
    force = spec.sensor.accelerometer
    timed = force is not None and force.velocity_increments
    if spec.sensor.clock_error and has_common_clock(spec) and (timed or spec.sensor.gyro is not None):
        terms.append(model.CommonScale(np.array([spec.sensor.clock_error]), "sample_clock", forces=timed))
    return tuple(terms)


# The axes to which the terms of a section belong: none, the other axes, all of them.
_OVER: dict[str, Callable[[str], Iterable[tuple[str, ...]]]] = {
    "itself": lambda _: [()],
    "others": lambda axis: [(b,) for b in AXIS_NAMES if b != axis],
    "all": lambda _: [(b,) for b in AXIS_NAMES],
}
# Section, axes, signals ({own}: the channel's axis), name, symbol, SI unit.
_OF_GYRO = (
    ("misalignment", "others", ("rate {}",), MISALIGNMENT, "m_{}", "rad"),
    ("g_sensitivity", "all", ("force {}",), G_SENSITIVITY, "g_{}", "rad/s/(m/s^2)"),
)
_OF_ACCELEROMETER = (
    ("bias", "itself", (), SPECIFIC_FORCE_BIAS, "a", "m/s^2"),
    ("scale_factor", "itself", ("force {own}",), model.SCALE_FACTOR, "s", "1"),
    ("misalignment", "others", ("force {}",), MISALIGNMENT, "m_{}", "rad"),
    ("second_order", "itself", ("force {own}",) * 2, SECOND_ORDER, "k2", "1/(m/s^2)"),
    ("lever_arm", "all", ("size {own}{}",), "lever_arm_{}", "r_{}", "m"),
)


def _signal_maps(triad: GyroTriad | AccelerometerTriad, axis: str) -> list[SignalMap]:
    """The terms of a channel's signals."""
    return [
        _signal_map(
            section,
            tuple(s.format(*of, own=axis) for s in signals),
            name.format(*of),
            symbol.format(*of),
            unit,
            float(triad.turn_on_bias or 0.0) if key == "bias" else 0.0,
        )
        for key, over, signals, name, symbol, unit in (_OF_GYRO if isinstance(triad, GyroTriad) else _OF_ACCELEROMETER)
        if (section := getattr(triad, key)) is not None
        for of in _OVER[over](axis)
    ]


def _rotation_terms(gyro: GyroTriad) -> Iterator[RotationSensitivity]:
    """What a gyro that is sensitive to acceleration feels of rotation: six products of two rates."""
    if gyro.g_sensitivity is not None and (std := gyro.g_sensitivity.of_rotation):
        for of in combinations_with_replacement(AXIS_NAMES, 2):
            pair, signals = "".join(of), tuple(f"rate {a}" for a in of)
            yield RotationSensitivity(
                temperature=_CONSTANT,
                std=np.asarray(std),
                signals=signals,
                name=f"rotation_{pair}",
                symbol=f"ww_{pair}",
                si_unit="s",
            )


def _path_terms(
    sensor: sensor_file.Sensor, triad: GyroTriad | AccelerometerTriad, axis: str
) -> list[PathTerm | OwnTerm]:
    """The terms of a channel that depend on the path of temperature, and those of classes from outside."""
    gyro = isinstance(triad, GyroTriad)
    own, unit = (f"{'rate' if gyro else 'force'} {axis}",), "rad/s" if gyro else "m/s^2"

    def play(p: PlayOfBias, signals: tuple[str, ...], name: str, si_unit: str) -> PathTerm:
        std, width = np.asarray(float(p.prior)), np.asarray(float(p.width))
        named = name.format(f"{float(width):g}")
        return Hysteresis(std=std, width=width, signals=signals, name=named, si_unit=si_unit)

    terms: list[PathTerm | OwnTerm] = [play(p, (), HYSTERESIS, f"{unit}/K") for p in triad.hysteresis]
    terms += [play(p, own, SCALE_FACTOR_HYSTERESIS, "1/K") for p in triad.scale_factor_hysteresis]
    if (gradient := triad.scale_factor_temperature_gradient) is not None:
        terms.append(GradientOfScale(std=np.asarray(float(gradient.prior)), signals=own, name=GRADIENT_OF_SCALE))
    if (second := triad.thermometer_difference) is not None:
        assert sensor.second_thermometer is not None
        other = OtherTemperature(SECOND, float(sensor.second_thermometer.lag))
        std = np.asarray(float(second.prior))
        terms.append(TemperatureDifference(std=std, other=other, signals=(), name=DIFFERENCE, si_unit=f"{unit}/K"))
    return terms + [_own_term(one) for one in triad.own]


def _own_term(one: OwnError) -> OwnTerm:
    if one.term is not None:
        return own_term(one.term, float(one.prior), one.name or one.term)
    name = one.name or " ".join(one.factors)
    return ProductTerm(std=np.asarray(float(one.prior)), name=name, factors=one.factors)


def _accelerometer(
    sensor: sensor_file.Sensor, triad: AccelerometerTriad, axis: str, processes: model.Processes
) -> model.SensorModel:
    white, terms = np.asarray(float(triad.velocity_random_walk)), list[Term](_signal_maps(triad, axis))
    if (gradient := triad.gradient_sensitivity) is not None:
        std = np.asarray(or_infinite(gradient.prior))
        terms.append(GradientOfBias(std=std, has_prior=bool(np.isfinite(std)), si_unit="m/s/K"))
    terms += _path_terms(sensor, triad, axis)
    return model.SensorModel(tuple(terms), white, processes, model.angle_reference())


def _signal_map(
    section,
    signals: tuple[str, ...],
    name: str,
    symbol: str,
    unit: str,
    common_std: float = 0.0,
) -> SignalMap:
    over = getattr(section, "temperature", None)
    of_temperature: Basis = _CONSTANT if over is None else basis(over)
    std = or_infinite(section.prior)
    return SignalMap(
        temperature=of_temperature,
        std=std,
        common_std=common_std,
        signals=signals,
        name=name,
        symbol=symbol,
        si_unit=unit,
        has_prior=bool(np.all(np.isfinite(std))),
        late=late_of(section),
    )


def geometry(rig: Rig) -> Geometry:
    """The table's axes, the mountings, and the site."""
    mountings = []
    for mounting in rig.table.mounting:
        matrix = np.array(mounting.columns).T
        if mounting.rotation is not None:
            vector = np.array([float(a) for a in mounting.rotation])
            if (size := np.linalg.norm(vector)) > 0.0:
                matrix = matrix @ trajectory.rotation(vector / size, np.asarray(size))
        mountings.append(matrix)
    return Geometry(
        np.array([axis.unit_vector for axis in rig.table.axis]),
        np.eye(3),
        np.array(mountings),
        np.asarray(rig.site.latitude_rad),
        np.asarray(rig.site.gravity_m_per_s2),
    )


class RestPoses(NamedTuple):
    """The `n` rests of a plan: `start` and `duration` s, and `up` `(n, 3)`, the vertical seen from the body."""

    start: np.ndarray
    duration: np.ndarray
    up: np.ndarray


def rest_poses(built: BuiltImu) -> RestPoses:
    """The rests of a plan."""
    motion = built.motion
    line, at = motion.line, segments_of(motion, built.model)
    before, _ = motion.angles()
    stages = trajectory.frames(motion.geometry, before, motion.mounting)
    rests = (at.axis < 0) & ~line.gap[at.first]
    first = at.first[rests]
    return RestPoses(line.start[first], at.sums(line.duration)[rests], stages.attitude[first][:, 2, :])


def _motion(spec: Spec, of: ImuModel, change: Callable[[Schedule], Schedule] | None) -> TableMotion:
    """The motion of a spec's plan; `change`: what its times and rates become."""
    schedule, axes, start = _schedule(spec.schedule, spec)
    schedule = schedule if change is None else change(schedule)
    line = schedule.trajectory(spec.sensor.lag)
    # What fills a stretch stands.
    axis = np.array([*axes, -1])[np.minimum(np.asarray(schedule.pieces.move), len(axes))]
    # Between two stretches the table stands where the cycle began, up to whole turns, and the mounting changes.
    stretch = np.cumsum(np.diff(line.gap.astype(int), prepend=0) < 0)
    mounting = np.minimum(stretch, len(spec.rig.table.mounting) - 1)
    decays = [*_decays(of), *([] if spec.sensor.lag is None else [float(line.lag_rate)])]
    division = _divisions_by_decay(line, max(decays, default=0.0))
    if len(division[0]):
        line, source = line.divided(*division)
        axis, mounting = axis[source], mounting[source]
    fine = fineness(spec, of, line)
    motion = trajectory.table_motion(line, axis, mounting, geometry(spec.rig), start, *fine)
    motion = replace(motion, divisions=(division,))
    smooth = trajectory.divided_motion(motion, *_breaks(of), *fine)
    if not of.knows_path:
        return smooth
    plays = [term for term in of.terms if isinstance(term, Hysteresis)]
    widths = tuple(sorted({float(term.width) for term in plays}))
    on_path = replace(smooth, history=course_before(spec), others=of.others)
    return trajectory.motion_divided_by_plays(on_path, widths, *fine)


def _decays(of: ImuModel) -> list[float]:
    """The rates (1/s) at which exponentials in a model's columns decay."""
    return [1.0 / other.lag for other in of.others if other.lag]


def _divisions(spec: Spec, of: ImuModel, built: BuiltImu) -> tuple[object, ...]:
    """What divides the motion of a plan into pieces, and the nodes of these, for other error terms than it was built
    for."""
    path = [term for term in of.terms if isinstance(term, PathTerm)]
    times = of.others, [(type(term), term.name) for term in path]
    return spec.sensor.lag, times, _breaks(of), fineness(spec, of, built.motion.line)


def _schedule(plan: PlanSchedule | StandardSchedule, spec: Spec) -> tuple[Schedule, list[int], np.ndarray]:
    """The schedule of a plan as a channel sees it that every axis turns, the axis of each of its moves (−1: a rest),
    and the axes' angles (rad) at its begin."""
    schedule = table_schedule(plan, spec)
    if isinstance(plan, StandardSchedule):
        return schedule, [-1] + [0] * len(plan.rates), np.zeros(len(spec.rig.table.axis))
    return schedule, [s.axis for s in (*plan.every_step, *plan.after)], np.array(plan.start)


def _divisions_by_decay(line: trajectory.Trajectory, decay: float) -> tuple[np.ndarray, np.ndarray]:
    """Pieces and fractions of them at which they are bisected towards their start, so that an exponential that decays
    at `decay` for s (of a thermal lag) changes little in each part."""
    decays = np.where(line.gap, 0.0, line.duration) * decay
    halves = np.ceil(np.log2(np.maximum(decays / _LAG_TIMES, 1.0))).astype(int)
    pieces = np.repeat(np.arange(len(halves)), halves)
    order = np.concatenate([np.zeros(0), *(np.arange(count, 0, -1) for count in halves)])
    return pieces, 0.5**order


def fineness(spec: Spec, of: ImuModel, line: trajectory.Trajectory) -> tuple[int | None, int]:
    """The fastest wave in a column, in cycles a turn, and the number of nodes of a turning piece without waves. No
    column has waves if every gyro lies along the only axis of a table, whose encoder's error counts at the readings."""
    orders = [h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics]
    own = (Map, Discrepancy, GradientOfBias, PathTerm)
    frame = geometry(spec.rig)
    along = [np.abs(frame.axes[0] @ mounting) for mounting in frame.mountings]
    plain = (
        len(frame.axes) == 1
        and all(c.kind == "gyro" and all(np.all(a == np.eye(3)[c.axis]) for a in along) for c in of.channels)
        and all(isinstance(term, own) for c in of.channels for term in c.model.terms)
        and all(isinstance(term, model.AxisHarmonics | model.CommonScale) for term in of.installation)
    )
    rated = (c.model for c in of.channels if any(isinstance(t, Map) for t in c.model.terms))
    # A single node is that of a standing piece.
    nodes = max((trajectory.rule_of(one, line).moving for one in rated), default=_FEWEST)
    nodes = max(nodes, 2)
    return (0 if orders else None, nodes) if plain else (waves_of(spec), max(nodes, _FEWEST))


def waves_of(spec: Spec) -> int:
    """The fastest wave in a column of an IMU, in cycles a turn."""
    orders = [h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics]
    return max(_WAVES, max(orders, default=0) + 1)


def _breaks(of: ImuModel) -> tuple[tuple[float, ...], dict[int, tuple[float, ...]]]:
    """Where functions of temperature (degC) and, for each gyro's axis, of its rate (rad/s) are not smooth."""
    warm: set[float] = set()
    fast: dict[int, set[float]] = {}
    for c in of.channels:
        for term in c.model.terms:
            if isinstance(term, Map | SignalMap):
                warm.update(term.temperature.breaks)
            if isinstance(term, Map) and term.rate is not None and term.rate.breaks:
                fast.setdefault(c.axis, set()).update(term.rate.breaks)
    return tuple(sorted(warm)), {axis: tuple(sorted(at)) for axis, at in fast.items()}


def hung_alike(spec: Spec) -> list[tuple[Spec, list[str]]]:
    """The spec of the IMU at each place that hangs differently, with the names of the places that hang so; of a table
    without places the spec itself."""
    alike: dict[str, tuple[Spec, list[str]]] = {}
    for name, at in specs_at_places(spec).items():
        hung = [m.model_dump(exclude={"name"}) for m in at.rig.table.mounting]
        alike.setdefault(repr((hung, at.sensor.model_dump())), (at, []))[1].append(name)
    return list(alike.values())
