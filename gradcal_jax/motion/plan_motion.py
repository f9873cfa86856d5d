"""The motion of a spec's plan: `Spec` in, `Schedule` out; with an `ImuModel`, which decides how finely its terms are
integrated, a `TableMotion`."""

from dataclasses import replace

import numpy as np

from gradcal_jax.model import AxisHarmonics, CommonScale, Hysteresis, ImuModel, Map, OwnTerm
from gradcal_jax.motion.gauss import moving_nodes
from gradcal_jax.motion.motion import Move, rest, turn
from gradcal_jax.motion.programme import Programme, programme
from gradcal_jax.motion.schedule import Schedule, gradient_plan, standard_plan
from gradcal_jax.motion.table_motion import (
    Geometry,
    TableMotion,
    divided_motion,
    motion_divided_by_plays,
    rotation,
    table_motion,
)
from gradcal_jax.motion.trajectory import Trajectory
from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import PlanSchedule, StandardSchedule
from gradcal_jax.spec.sensor import GyroTriad
from gradcal_jax.spec.spec_sections import Spec

_LAG_TIMES = 8.0
# A varying rate is integrated on the nodes of a piece, against exponentials of at most this many correlation times.
_CORRELATION_TIMES_A_PIECE = 3.0
# Fastest wave of a body whose attitude matters, in cycles a turn: squares of the force's components, or harmonics times
# a direction.
_WAVES = 3
_FEWEST = 16


def geometry(rig: Rig) -> Geometry:
    """The table's axes, the mountings, and the site."""
    mountings = []
    for mounting in rig.table.mounting:
        matrix = np.array(mounting.columns).T
        if mounting.rotation is not None:
            vector = np.array([float(a) for a in mounting.rotation])
            if (size := np.linalg.norm(vector)) > 0.0:
                matrix = matrix @ rotation(vector / size, np.asarray(size))
        mountings.append(matrix)
    axes = np.array([axis.unit_vector for axis in rig.table.axis])
    site = np.asarray(rig.site.latitude_rad), np.asarray(rig.site.gravity_m_per_s2)
    return Geometry(axes, np.eye(3), np.array(mountings), *site)


def course_before(spec: Spec) -> np.ndarray | None:
    """Turning points of the temperature (°C) before the spec's plan."""
    before = () if isinstance(spec.plan, StandardPlan) else spec.plan.before
    return np.array([float(t) for t in before]) if before else None


def plan_motion(spec: Spec, model: ImuModel) -> TableMotion:
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
    motion = table_motion(line, axis, mounting, geometry(spec.rig), start, *fineness(spec, model, line))
    smooth = divided_motion(replace(motion, divisions=(division,)), *_breaks(model))
    if not model.knows_path:
        return smooth
    widths = {float(term.width) for term in model.terms if isinstance(term, Hysteresis)}
    return motion_divided_by_plays(replace(smooth, history=course_before(spec)), tuple(sorted(widths)))


def moves_alike(spec: Spec, model: ImuModel, line: Trajectory) -> tuple[object, ...]:
    """What divides a plan's motion into pieces, and the nodes of these: models with the same one share their motion."""
    of_path = [(type(term), term.name) for term in model.terms if isinstance(term, OwnTerm)]
    return spec.sensor.lag, of_path, _breaks(model), fineness(spec, model, line)


def _divisions_by_decay(line: Trajectory, decay: float) -> tuple[np.ndarray, np.ndarray]:
    """Pieces and fractions of them at which they are bisected towards their start, so that an exponential that decays
    at `decay` for s (of a thermal lag) changes little in each part."""
    decays = np.where(line.gap, 0.0, line.duration) * decay
    halves = np.ceil(np.log2(np.maximum(decays / _LAG_TIMES, 1.0))).astype(int)
    pieces = np.repeat(np.arange(len(halves)), halves)
    # Of a piece with k divisions k, k − 1, …, 1.
    order = np.repeat(np.cumsum(halves), halves) - np.arange(len(pieces))
    return pieces, 0.5**order


def fineness(spec: Spec, model: ImuModel, line: Trajectory) -> tuple[int | None, int]:
    """The fastest wave in a column, in cycles a turn, and the number of nodes of a turning piece without waves. No
    column has waves if every gyro lies along the only axis of a table, whose encoder's error counts at the readings."""
    nodes = [1]
    for c in model.channels:
        maps = [term.whole for term in c.terms if isinstance(term, Map) and term.of_own_input]
        if c.kind == "gyro" and maps:
            of_temperature = max(of.temperature.degree for of in maps)
            nodes.append(moving_nodes(line, of_temperature, max(of.rate.degree for of in maps)))
    most = max(nodes)
    orders = [h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics]
    if not _along_its_axis(spec.rig, model):
        return max(_WAVES, max(orders, default=0) + 1), max(most, _FEWEST)
    # A single node is that of a standing piece.
    return 0 if orders else None, max(most if nodes[1:] else _FEWEST, 2)


def _along_its_axis(rig: Rig, model: ImuModel) -> bool:
    """Whether every channel is a gyro along the only axis of a table, and all depends on its rate alone."""
    frame = geometry(rig)
    turned = [np.abs(frame.axes[0] @ mounting) for mounting in frame.mountings]
    return (
        len(frame.axes) == 1
        and all(c.kind == "gyro" for c in model.channels)
        and all(np.all(axis == np.eye(3)[c.axis]) for c in model.channels for axis in turned)
        and all(term.of_own_input for term in model.terms)
        and all(isinstance(term, AxisHarmonics | CommonScale) for term in model.installation)
    )


def _breaks(model: ImuModel) -> tuple[tuple[float, ...], dict[int, tuple[float, ...]]]:
    """Where functions of temperature (degC) and, for each gyro's axis, of its rate (rad/s) are not smooth."""
    warm: set[float] = set()
    fast: dict[int, set[float]] = {}
    for c in model.channels:
        for term in c.terms:
            if isinstance(term, Map):
                warm.update(term.temperature.breaks)
                if term.rate.breaks:
                    fast.setdefault(c.axis, set()).update(term.rate.breaks)
    return tuple(sorted(warm)), {axis: tuple(sorted(at)) for axis, at in fast.items()}


def plan_schedule(spec: Spec) -> Schedule:
    """The schedule of a spec's plan as a channel sees it that every axis turns."""
    plan = spec.schedule
    if isinstance(plan, StandardSchedule):
        points = (plan.temperatures, plan.soak_each, plan.integration, plan.rates)
        return standard_plan(*points, points=plan.shared)
    table, gyro = spec.rig.table, spec.sensor.gyro
    course, used = chamber_programme(plan)
    every = float(table.axis[0].angle.read_every) if table.standing == "read" else None
    longest = np.inf if gyro is None else _longest_piece(gyro)

    def move(of: ResolvedMove) -> Move:
        spacing = every if of.reads_as_table else of.read_every
        if of.is_rest:
            return rest(of.duration, spacing, read_at_end=bool(of.read_end))
        return turn(
            of.shape,
            of.peak_rate,
            of.duration,
            ramp=of.ramp,
            unevenness=of.unevenness,
            read_at_end=of.read_end,
            read_every=spacing,
            longest_piece=longest,
        )

    # (Steps behind the cycle are made once.)
    moves, after = (tuple(move(s.move) for s in part) for part in (plan.steps, plan.after))
    # What no cycle fills is read once at its end, but by an operator, who types angles after turns only.
    left = None if every is None or (np.isinf(every) and not table.typed) else every
    return gradient_plan(course, moves, after, used=used, read_every=left)


def chamber_programme(plan: PlanSchedule) -> tuple[Programme, tuple[tuple[int, int], ...]]:
    """The chamber's programme, and the pairs of its knots between which data are used."""
    segments = plan.segments
    ends = np.array([segment.start for segment in segments] + [plan.duration])

    def nearest(time: float) -> int:
        return int(np.argmin(np.abs(ends - time)))

    used = tuple((nearest(s.start), nearest(s.start + s.duration)) for s in plan.stretches)
    return programme(segments[0].temperature_start, [(s.duration, s.slope) for s in segments]), used


def _longest_piece(sensor: GyroTriad) -> float:
    """Duration (s) of the longest piece of a varying rate: a few of the shortest correlation time of what it drives."""
    times = [float(d.correlation_time) for d in sensor.scale_factor_instability]
    if (error := sensor.thermometer_noise) is not None and error.correlation_time is not None:
        times.append(float(error.correlation_time))
    return _CORRELATION_TIMES_A_PIECE * min(times, default=np.inf)
