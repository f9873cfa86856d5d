"""A spec in the core's terms: its channels, its installation, and the motion of the table."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from gradcal_jax import model
from gradcal_jax import motion as trajectory
from gradcal_jax.model import (
    AXIS_NAMES,
    BIAS,
    SCALE_FACTOR,
    SLOPE,
    Basis,
    BodyNodes,
    BSpline,
    Channel,
    ChannelKind,
    Discrepancy,
    GradientOfBias,
    Hysteresis,
    ImuModel,
    Map,
    OwnTerm,
    Polynomial,
    Processes,
    ProductTerm,
    Term,
    make_map,
    term_of_class,
)
from gradcal_jax.model.terms import CONSTANT, known_terms
from gradcal_jax.motion import Geometry, Move, Schedule, TableMotion
from gradcal_jax.spec.bases import PolynomialKeys
from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.memory import too_large
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.places import specs_at_places
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import PlanSchedule, StandardSchedule
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad, Sensor
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.temperature_path import GeneralTerm

# Names of terms, for requirements and sentences.
MISALIGNMENT = "misalignment_{}"
G_SENSITIVITY = "g_sensitivity_{}"
SECOND_ORDER = "second_order"
HYSTERESIS = "hysteresis_{}K"
SCALE_FACTOR_HYSTERESIS = "scale_factor_hysteresis_{}K"
_LAGGED = 16
_LAG_TIMES = 8.0
# A varying rate is integrated on the nodes of a piece, against exponentials of at most this many correlation times.
_CORRELATION_TIMES_A_PIECE = 3.0
# Fastest wave of a body whose attitude matters, in cycles a turn: squares of the force's components, or harmonics times
# a direction.
_WAVES = 3
_FEWEST = 16
# Standard deviation of an angle that is known exactly, rad: far below any encoder's.
_EXACT = 1e-12
# Standard deviation (rad) of a standstill's angle that no encoder tells: unknown beside what gravity and the gyros say,
# and small enough for a covariance in double precision to hold 0.1 µrad beside it.
_UNKNOWN = 3.0


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


def build_imu(spec: Spec, like: BuiltImu | None = None) -> BuiltImu:
    """Model and motion of an IMU's spec. `like`: an IMU with the same plan and other error terms, whose motion serves
    if the terms need the same pieces. Errors: `MemoryError` for a plan with more readings than this machine can hold,
    `ValueError` for a fixture of several IMUs."""
    if spec.rig.table.place:
        raise ValueError(
            "the spec has a fixture of several IMUs, and only predict, optimise and estimate support fixtures; for "
            "other commands, write the mounting of one place as rig.table.mounting, and remove rig.table.place"
        )
    if too := too_large(spec):
        raise MemoryError(too)
    model_, sources = _kept(spec.sensor, spec.rig, _has_common_clock(spec), known_terms())
    bases = [t.temperature for t in model_.terms if isinstance(t, Map | Discrepancy)]
    degree = max(_degree(b) for b in bases)
    # A lagging unit's exponentials are no polynomials; a play is linear in T on each piece.
    own = any(isinstance(t, OwnTerm) and not isinstance(t, Hysteresis | ProductTerm) for t in model_.terms)
    exponential = spec.sensor.lag is not None or own
    points = max(degree + 1, _LAGGED if exponential else 2 if model_.knows_path else 1)
    rough = model_.knows_path or any(b.breaks for b in bases)
    if like is not None and _divisions(spec, model_, like) == _divisions(like.spec, like.model, like):
        return BuiltImu(spec, model_, like.motion, points, rough, sources, gears=like.gears)
    gears = gears_of(spec) if like is None else like.gears
    return BuiltImu(spec, model_, _motion(spec, model_), points, rough, sources, gears=gears)


def course_before(spec: Spec) -> np.ndarray | None:
    """Turning points of the temperature (°C) before the spec's plan."""
    before = () if isinstance(spec.plan, StandardPlan) else spec.plan.before
    return np.array([float(t) for t in before]) if before else None


def gears_of(spec: Spec) -> list[tuple[float, float]]:
    """Standard deviations of scale error and backlash (rad) of every axis, as far as the covariance of readings is to
    contain them; empty: none. Readings along the only axis of a table take a scale error for one of the gyro's: there
    it counts instead, and so does a typical one of any axis."""
    table = spec.rig.table
    if table.by_gravity or isinstance(spec.plan, StandardPlan):
        return []
    angles = [axis.angle for axis in table.axis]
    scaled = not spec.is_one_axis and all(angle.scale_error is not None for angle in angles)
    sizes = [(float(a.scale_error or 0.0) * scaled, float(a.backlash or 0.0)) for a in angles]
    return sizes if np.any(sizes) else []


def unweighted_estimator(spec: Spec) -> bool:
    """Whether the spec's estimator is ordinary least squares on the points' rates, as in the paper's figure."""
    return isinstance(spec.plan, StandardPlan) and spec.plan.estimator == "least squares"


def _has_common_clock(spec: Spec) -> bool:
    """Whether the sample clock is a parameter common to all channels; independent points each have their own."""
    return not isinstance(spec.plan, StandardPlan) or spec.plan.points == "one run"


def _installation(sensor: Sensor, rig: Rig, common_clock: bool) -> tuple[model.InstallationTerm, ...]:
    table, site = rig.table, rig.site
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
    if sensor.frame == "case":
        terms.append(model.MountingError(np.repeat(np.array([float(m.accuracy) for m in table.mounting]), 3)))
    if site.gravity_accuracy and sensor.accelerometer is not None:
        terms.append(model.CommonScale(np.array([float(site.gravity_accuracy)]), "gravity"))
    force = sensor.accelerometer
    timed = force is not None and force.velocity_increments
    if sensor.clock_error and common_clock and (timed or sensor.gyro is not None):
        terms.append(model.CommonScale(np.array([sensor.clock_error]), "sample_clock", forces=timed))
    return tuple(terms)


# The axes to which the terms of a section belong: none, the other axes, all of them.
_OVER: dict[str, Callable[[str], Iterable[tuple[str, ...]]]] = {
    "itself": lambda _: [()],
    "others": lambda axis: [(b,) for b in AXIS_NAMES if b != axis],
    "all": lambda _: [(b,) for b in AXIS_NAMES],
}
# Section, axes, signals ({own}: the channel's axis), name, symbol, SI unit.
_MAPS: dict[ChannelKind, tuple[tuple[str, str, tuple[str, ...], str, str, str], ...]] = {
    "gyro": (
        ("bias", "itself", (), BIAS, "a", "rad/s"),
        ("scale_factor", "itself", ("rate {own}",), SCALE_FACTOR, "b", "1"),
        ("misalignment", "others", ("rate {}",), MISALIGNMENT, "m_{}", "rad"),
        ("g_sensitivity", "all", ("force {}",), G_SENSITIVITY, "g_{}", "rad/s/(m/s^2)"),
    ),
    "accelerometer": (
        ("bias", "itself", (), BIAS, "a", "m/s^2"),
        ("scale_factor", "itself", ("force {own}",), SCALE_FACTOR, "s", "1"),
        ("misalignment", "others", ("force {}",), MISALIGNMENT, "m_{}", "rad"),
        ("second_order", "itself", ("force {own}",) * 2, SECOND_ORDER, "k2", "1/(m/s^2)"),
    ),
}
_WHITE: dict[ChannelKind, str] = {"gyro": "angle_random_walk", "accelerometer": "velocity_random_walk"}


def _model_and_sources(
    sensor: Sensor, rig: Rig, common_clock: bool, _classes: tuple[type[OwnTerm], ...]
) -> tuple[ImuModel, dict[ChannelKind, dict[str, tuple[int, ...]]]]:
    """Model and noise sources of a sensor on a rig; kept, since the points of a sweep have plans of their own only.
    `_classes`: of terms, which may be defined anew."""
    channels: list[Channel] = []
    sources: dict[ChannelKind, dict[str, tuple[int, ...]]] = {}
    for kind in model.KINDS:
        triad = getattr(sensor, kind)
        if triad is None:
            continue
        processes, sources[kind] = _processes(sensor, rig, common_clock, triad)
        white = np.asarray(float(getattr(triad, _WHITE[kind])))
        for axis in triad.axes:
            terms = tuple(_terms(triad, kind, axis))
            channels.append(Channel(terms, white, processes, kind, AXIS_NAMES.index(axis)))
    table, angles = rig.table, [axis.angle for axis in rig.table.axis]
    numbers = ("standstill_offset", "reading_noise", "read_every", "timing_error")
    offset, reading, every, timing = (np.array([float(getattr(a, name)) for a in angles]) for name in numbers)
    if table.by_gravity:
        offset, reading, every = np.full(len(angles), _UNKNOWN), np.zeros(len(angles)), np.full(len(angles), np.inf)
    rate = np.asarray(float(table.rate_accuracy or 0.0))
    held = table.standing == "held"
    encoder = model.EncoderNoise(offset, reading, every, held, timing, rate, held or bool(np.any(offset)))
    return ImuModel(tuple(channels), _installation(sensor, rig, common_clock), encoder), sources


_kept: Callable[..., tuple[ImuModel, dict[ChannelKind, dict[str, tuple[int, ...]]]]]
_kept = lru_cache(maxsize=16)(_model_and_sources)


def _processes(
    sensor: Sensor, rig: Rig, common_clock: bool, triad: GyroTriad | AccelerometerTriad
) -> tuple[Processes, dict[str, tuple[int, ...]]]:
    """The noise processes of a channel, and their indices by error source: its own, the sample clock where it is no
    common parameter of all channels, and the Earth's rate where no bias is estimated that includes it."""
    total = model.no_processes()
    sources: dict[str, tuple[int, ...]] = {}

    def add(name: str, process: Processes) -> None:
        nonlocal total
        sources[name] = (*sources.get(name, ()), total.count)
        total = total + process

    for d in triad.drift:
        add("bias instability", model.gauss_markov(float(d.standard_deviation), float(d.correlation_time)))
    gyro = triad if isinstance(triad, GyroTriad) else None
    if gyro is not None and gyro.rate_random_walk:
        add("rate random walk", model.rate_random_walk(float(gyro.rate_random_walk)))
    for d in triad.scale_factor_instability:
        figures = float(d.standard_deviation), float(d.correlation_time)
        add("scale-factor instability", model.gauss_markov(*figures, bias_gain=0.0, rate_gain=1.0))
    if (error := triad.thermometer_noise) is not None:
        # All channels share a thermometer, but the signs of their slopes are unknown: their errors are uncorrelated.
        gains = {"bias_gain": float(error.bias_slope or 0.0), "rate_gain": float(error.scale_factor_slope or 0.0)}
        time = np.inf if error.correlation_time is None else float(error.correlation_time)
        add("temperature measurement", model.gauss_markov(float(error.standard_deviation), time, **gains))
    if gyro is not None and sensor.clock_error and not common_clock:
        add("sample clock", model.constant(sensor.clock_error, rate_gain=1.0))
    if triad.turn_on_bias and triad.bias is None:
        add("turn-on bias", model.constant(float(triad.turn_on_bias), bias_gain=1.0))
    if gyro is not None and rig.site.is_unknown and gyro.bias is None:
        # Rectangular within the whole rate.
        add("Earth's rate", model.constant(trajectory.EARTH_RATE / 3.0**0.5, bias_gain=1.0))
    return total, sources


def _terms(triad: GyroTriad | AccelerometerTriad, kind: ChannelKind, axis: str) -> Iterator[Term]:
    """The terms of a channel in the order of its parameters."""
    maps = [
        _map(triad, key, tuple(s.format(*of, own=axis) for s in signals), name.format(*of), symbol.format(*of), unit)
        for key, over, signals, name, symbol, unit in _MAPS[kind]
        if getattr(triad, key) is not None
        for of in _OVER[over](axis)
    ]
    yield from maps
    if isinstance(triad, GyroTriad):
        yield from _rotation_terms(triad)
    unit, own = ("rad/s", f"rate {axis}") if kind == "gyro" else ("m/s^2", f"force {axis}")
    if (gradient := triad.gradient_sensitivity) is not None:
        yield GradientOfBias(std=float(or_infinite(gradient.prior)), unit="rad/K" if kind == "gyro" else "m/s/K")
    plays = [(play, HYSTERESIS, f"{unit}/K", ()) for play in triad.hysteresis]
    plays += [(play, SCALE_FACTOR_HYSTERESIS, "1/K", (own,)) for play in triad.scale_factor_hysteresis]
    for play, name, of_play, signals in plays:
        prior, width = np.asarray(float(play.prior)), np.asarray(float(play.width))
        called = name.format(f"{float(width):g}")
        yield Hysteresis(std=prior, name=called, unit=of_play, signals=signals, width=width)
    for one in triad.term:
        yield _general_term(one, unit, own)
    yield from (m.beyond for m in maps if m.beyond is not None)


def _map(
    triad: GyroTriad | AccelerometerTriad, key: str, signals: tuple[str, ...], name: str, symbol: str, unit: str
) -> Map:
    """The map of a section with its priors. The constant of a bias *is* this run's turn-on bias, so their priors
    add."""
    section = getattr(triad, key)
    temperature, rate, beyond = (getattr(section, of, None) for of in ("temperature", "rate", "discrepancy"))
    hidden = None
    if beyond is not None:
        hidden = float(beyond.standard_deviation), beyond.temperature_degree, getattr(beyond, "rate_degree", 0)
    return make_map(
        CONSTANT if temperature is None else basis(temperature),
        None if rate is None else basis(rate),
        name=name,
        symbol=symbol,
        unit=unit,
        signals=signals,
        numbered=isinstance(triad, GyroTriad) and key == "bias",
        prior_std=or_infinite(section.prior),
        smoothness_std=float(or_infinite(getattr(section, "smoothness", None))),
        common_std=float(triad.turn_on_bias or 0.0) if key == "bias" else 0.0,
        discrepancy=hidden,
    )


def _rotation_terms(gyro: GyroTriad) -> Iterator[ProductTerm]:
    """Bias of a gyro by six products of two rates: its sensitivity to acceleration, times the centripetal acceleration
    at its place, from where the specific force is known."""
    if gyro.g_sensitivity is None or not (std := gyro.g_sensitivity.of_rotation):
        return
    for of in combinations_with_replacement(AXIS_NAMES, 2):
        signals = tuple(f"rate {a}" for a in of)
        yield ProductTerm(std=np.asarray(std), name=f"ww_{''.join(of)}", unit="s", signals=signals)


def _general_term(one: GeneralTerm, of_bias: str, own: str) -> OwnTerm:
    """A `[[term]]` of a channel with the unit `of_bias` of its bias and the input `own`."""
    of_scale, unit = one.target == "scale_factor", one.si_unit(of_bias)
    std = np.asarray(one.prior_in_si(of_bias))
    if one.class_name is not None:
        return term_of_class(one.class_name, float(std), one.name, unit)
    signals = tuple(factor for factor in one.factors if factor != SLOPE)
    every = ((own,) if of_scale else ()) + signals
    slopes = one.factors.count(SLOPE)
    return ProductTerm(std=std, name=one.name, unit=unit, signals=every, slopes=slopes)


def basis(section) -> Basis:
    """A basis of the core from its section of a spec."""
    if isinstance(section, PolynomialKeys):
        return Polynomial(section.degree, float(section.centre), float(section.scale))
    knots = tuple(float(k) for k in section.knots)
    return BSpline(knots, section.degree)


def or_infinite(value: float | tuple[float, ...] | None) -> np.ndarray:
    """The prior's standard deviation, or that of each coefficient; infinite (a flat prior) where it is absent."""
    return np.asarray(np.inf if value is None else value, dtype=float)


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


def _motion(spec: Spec, of: ImuModel) -> TableMotion:
    """The motion of a spec's plan."""
    plan, schedule = spec.schedule, plan_schedule(spec)
    # The axis of each move (−1: a rest), and the axes' angles (rad) as the plan begins.
    if isinstance(plan, StandardSchedule):
        axes, start = [-1] + [0] * len(plan.rates), np.zeros(len(spec.rig.table.axis))
    else:
        axes, start = [s.axis for s in (*plan.steps, *plan.after)], np.array(plan.start)
    line = schedule.trajectory(spec.sensor.lag)
    # What fills a stretch stands.
    axis = np.array([*axes, -1])[np.minimum(np.asarray(schedule.pieces.move), len(axes))]
    # Between two stretches the table stands where the cycle began, up to whole turns, and the mounting changes.
    stretch = np.cumsum(np.diff(line.gap.astype(int), prepend=0) < 0)
    mounting = np.minimum(stretch, len(spec.rig.table.mounting) - 1)
    division = _divisions_by_decay(line, 0.0 if spec.sensor.lag is None else float(line.lag_rate))
    if len(division[0]):
        line, source = line.divided(*division)
        axis, mounting = axis[source], mounting[source]
    fine = fineness(spec, of, line)
    motion = trajectory.table_motion(line, axis, mounting, geometry(spec.rig), start, *fine)
    motion = replace(motion, divisions=(division,))
    smooth = trajectory.divided_motion(motion, *_breaks(of))
    if not of.knows_path:
        return smooth
    widths = tuple(sorted({float(term.width) for term in of.terms if isinstance(term, Hysteresis)}))
    on_path = replace(smooth, history=course_before(spec))
    return trajectory.motion_divided_by_plays(on_path, widths)


def _divisions(spec: Spec, of: ImuModel, built: BuiltImu) -> tuple[object, ...]:
    """What divides the motion of a plan into pieces, and the nodes of these, for other error terms than it was built
    for."""
    path = [term for term in of.terms if isinstance(term, OwnTerm)]
    names = [(type(term), term.name) for term in path]
    return spec.sensor.lag, names, _breaks(of), fineness(spec, of, built.motion.line)


def _divisions_by_decay(line: trajectory.Trajectory, decay: float) -> tuple[np.ndarray, np.ndarray]:
    """Pieces and fractions of them at which they are bisected towards their start, so that an exponential that decays
    at `decay` for s (of a thermal lag) changes little in each part."""
    decays = np.where(line.gap, 0.0, line.duration) * decay
    halves = np.ceil(np.log2(np.maximum(decays / _LAG_TIMES, 1.0))).astype(int)
    pieces = np.repeat(np.arange(len(halves)), halves)
    # Of a piece with k divisions k, k − 1, …, 1.
    order = np.repeat(np.cumsum(halves), halves) - np.arange(len(pieces))
    return pieces, 0.5**order


def fineness(spec: Spec, of: ImuModel, line: trajectory.Trajectory) -> tuple[int | None, int]:
    """The fastest wave in a column, in cycles a turn, and the number of nodes of a turning piece without waves. No
    column has waves if every gyro lies along the only axis of a table, whose encoder's error counts at the readings."""
    orders = [h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics]
    frame = geometry(spec.rig)
    along = [np.abs(frame.axes[0] @ mounting) for mounting in frame.mountings]
    plain = (
        len(frame.axes) == 1
        and all(c.kind == "gyro" and all(np.all(a == np.eye(3)[c.axis]) for a in along) for c in of.channels)
        and all(term.of_own_input for term in of.terms)
        and all(isinstance(term, model.AxisHarmonics | model.CommonScale) for term in of.installation)
    )
    nodes = [_FEWEST]
    for c in of.channels:
        maps = [t for t in c.terms if isinstance(t, Map | Discrepancy) and t.of_own_input]
        if c.kind == "gyro" and maps:
            degrees = [max((_degree(getattr(t, name)) for t in maps), default=0) for name in ("temperature", "rate")]
            nodes.append(trajectory.moving_nodes(line, *degrees))
    # A single node is that of a standing piece.
    most = max(nodes[1:] or nodes)
    return (0 if orders else None, max(most, 2)) if plain else (waves_of(spec), max(most, _FEWEST))


def _degree(of: Basis | None) -> int:
    return of.degree if isinstance(of, Polynomial | BSpline) else 0


def waves_of(spec: Spec) -> int:
    """The fastest wave in a column of an IMU, in cycles a turn."""
    orders = [h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics]
    return max(_WAVES, max(orders, default=0) + 1)


def _breaks(of: ImuModel) -> tuple[tuple[float, ...], dict[int, tuple[float, ...]]]:
    """Where functions of temperature (degC) and, for each gyro's axis, of its rate (rad/s) are not smooth."""
    warm: set[float] = set()
    fast: dict[int, set[float]] = {}
    for c in of.channels:
        for term in c.terms:
            if isinstance(term, Map):
                warm.update(term.temperature.breaks)
            if isinstance(term, Map) and term.rate.breaks:
                fast.setdefault(c.axis, set()).update(term.rate.breaks)
    return tuple(sorted(warm)), {axis: tuple(sorted(at)) for axis, at in fast.items()}


def plan_schedule(spec: Spec) -> Schedule:
    """The schedule of a spec's plan as a channel sees it that every axis turns."""
    plan = spec.schedule
    if isinstance(plan, StandardSchedule):
        points = (plan.temperatures, plan.soak_each, plan.integration, plan.rates)
        return trajectory.standard_plan(*points, points=plan.shared)
    table, gyro = spec.rig.table, spec.sensor.gyro
    course, used = chamber_programme(plan)
    every = float(table.axis[0].angle.read_every) if table.standing == "read" else None
    longest = np.inf if gyro is None else longest_piece(gyro)

    def move(of: ResolvedMove) -> Move:
        spacing = every if of.reads_as_table else of.read_every
        return move_of(replace(of, read_every=spacing), longest)

    # (Steps behind the cycle are made once.)
    moves, after = (tuple(move(s.move) for s in part) for part in (plan.steps, plan.after))
    # What no cycle fills is read once at its end, but by an operator, who types angles after turns only.
    left = None if every is None or (np.isinf(every) and not table.typed) else every
    return trajectory.gradient_plan(course, moves, after, used=used, read_every=left)


def chamber_programme(
    plan: PlanSchedule,
) -> tuple[trajectory.Programme, tuple[tuple[int, int], ...]]:
    """The chamber's programme, and the pairs of its knots between which data are used."""
    segments = plan.segments
    ends = np.array([segment.start for segment in segments] + [plan.duration])
    nearest = lambda time: int(np.argmin(np.abs(ends - time)))  # noqa: E731
    used = tuple((nearest(s.start), nearest(s.start + s.duration)) for s in plan.stretches)
    return trajectory.programme(segments[0].temperature_start, [(s.duration, s.slope) for s in segments]), used


def longest_piece(sensor: GyroTriad) -> float:
    """Duration (s) of the longest piece of a varying rate: a few of the shortest correlation time of what it drives."""
    times = [float(d.correlation_time) for d in sensor.scale_factor_instability]
    if (error := sensor.thermometer_noise) is not None and error.correlation_time is not None:
        times.append(float(error.correlation_time))
    return _CORRELATION_TIMES_A_PIECE * min(times, default=np.inf)


def move_of(move: ResolvedMove, longest_piece: float = np.inf) -> Move:
    """A move of a spec in the core's terms; times in s."""
    if move.is_rest:
        return trajectory.rest(move.duration, move.read_every, read_at_end=bool(move.read_end))
    return trajectory.turn(
        move.shape,
        move.peak_rate,
        move.duration,
        ramp=move.ramp,
        unevenness=move.unevenness,
        read_at_end=move.read_end,
        read_every=move.read_every,
        longest_piece=longest_piece,
    )


def hung_alike(spec: Spec) -> list[tuple[Spec, list[str]]]:
    """The spec of the IMU at each place that hangs differently, with the names of the places that hang so; of a table
    without places the spec itself."""
    alike: dict[str, tuple[Spec, list[str]]] = {}
    for name, at in specs_at_places(spec).items():
        hung = [m.model_dump(exclude={"name"}) for m in at.rig.table.mounting]
        alike.setdefault(repr((hung, at.sensor.model_dump())), (at, []))[1].append(name)
    return list(alike.values())
