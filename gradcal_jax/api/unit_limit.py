"""Proven lower limits on the residuals of any plan of a whole unit, in the time of the data of the spec's plan.

Two proofs. A **bias** `ψ(T)ᵀβ` under white noise and drift: with all else known exactly and the error itself observed
at every instant, moving or not, generalised least squares has a known covariance of β; every row of any plan is a
function of these observations.

A parameter multiplied by a **signal** s under white noise N² (a column `∫ψ s dt`): with all else known exactly, the
drift too, its information is `∫ψψᵀs²dt/N²` plus its prior's. For the k elements of a quantity that share ψ, N and
prior, the squares of the signals add up to at most `bound` at every instant, because |f| = g and |ω| ≤ the fastest
axis's rate (one axis turns at a time, on the Earth): so their mean information is at most `J = bound/k ∫ψψᵀdt/N² +
prior`. As `(ψᵀJ⁻¹ψ)^½` is convex in J, the mean of their standard deviations, and so the worst and the root mean
square, is at least that of J, at every temperature; and so is every statistic over temperature.

A gyro's scale factor is also a function of the rate: its limit is that of a single axis (`design.limit`) in white
noise that turns all the time.
"""

from typing import NamedTuple

import jax
import numpy as np

from gradcal_jax import model, trajectory
from gradcal_jax.api.limit import PlanLimit, plan_limit
from gradcal_jax.api.posterior_of_plan import UNIT_OF
from gradcal_jax.api.prediction import requirement_rows
from gradcal_jax.api.systematic import floor_of_unit_plan
from gradcal_jax.api.unit_build import MISALIGNMENT, SECOND_ORDER, AssembledUnit, assemble_unit
from gradcal_jax.api.unit_residual import unit_residual
from gradcal_jax.design import criterion, limit
from gradcal_jax.files.absent import with_typical
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, MisalignmentRequirement, UnitRequirement
from gradcal_jax.files.spec import goes_on
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import information, square_root, statistic
from gradcal_jax.model import AXIS_NAMES, Channel, Map, Polynomial, SignalMap
from gradcal_jax.trajectory import EARTH_RATE

# Longest time step of the integrals: as a share of the shortest correlation time, and in s.
_SHARE_OF_CORRELATION = 0.05
_LONGEST_S = 5.0
_NODES = 4
# Number of temperatures among which a scale factor's motion is divided.
_TEMPERATURES = 48
_RELAXED = (
    "everything else is known exactly",
    "the unit is read at every instant, moving or not, with the best distribution of turns and poses",
    "the noise is white, except for biases",
)


class _Look(NamedTuple):
    """The time of the plan in steps: `start`, `duration` s, the temperature (°C) at their `begin` and `end`, and
    whether their data are `used`."""

    start: np.ndarray
    duration: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    used: np.ndarray


def unit_limits(spec: UnitSpec) -> list[PlanLimit]:
    """The limit of every requirement of a unit's plan for which there is a proof.

    Errors: `ValueError` where no requirement has a proof, and for a spec with [[done]].
    """
    if spec.done:
        raise goes_on("a limit")
    built = assemble_unit(spec)
    proven = [(r, bound) for r in spec.requirement if (bound := _certified(built, r)) is not None]
    if not proven:
        raise ValueError(
            "a limit of a unit is proven for biases, scale factors that are polynomials, misalignments to the table or "
            "the case, acceleration sensitivity and second order; the spec has no requirement on one of these"
        )
    rows = {row.name: row for row in requirement_rows(spec)}
    floors = [floor_of_unit_plan(one) for one in (spec, with_typical(spec))]
    # What no residual shows, no plan removes: it adds in quadrature, at least its smallest value over the elements.
    limits: list[PlanLimit] = []
    for r, bound in proven:
        named, every = (float(np.min(unit_residual(of, floor, r).values)) for of, floor in floors)
        found = plan_limit(r, UNIT_OF[r.quantity], bound, rows[r.name].decisive, _RELAXED)
        limits.append(found.above(named, every, rows[r.name].judged))
    return limits


def _certified(built: AssembledUnit, requirement: UnitRequirement) -> tuple[float, float] | None:
    """A requirement's limit in SI: certified, and the optimum of the relaxed problem; None without a proof."""
    cold, warm = (float(t) for t in requirement.temperature)
    temperatures = np.linspace(cold, warm, requirement.grid[0])
    if isinstance(requirement, GyroScaleFactorRequirement):
        return _of_scale_factor(built, requirement, temperatures)
    of = _of_bias if requirement.quantity in ("gyro_bias", "accelerometer_bias") else _of_signal
    deviation = of(built, requirement, temperatures)
    if deviation is None:
        return None
    value = statistic(requirement.statistic, deviation[:, None])
    return value, value


def _of_scale_factor(
    built: AssembledUnit, requirement: GyroScaleFactorRequirement, temperatures: np.ndarray
) -> tuple[float, float] | None:
    """The limit for a gyro that turns all the time, at up to the rate of the rig's fastest axis."""
    channel = _channel(built, "gyro", requirement.axis)
    scale = channel.model.scale
    if scale is None or not isinstance(scale.rate, Polynomial) or scale.beyond is not None:
        return None
    rates = np.linspace(float(requirement.rate[0]), float(requirement.rate[1]), requirement.grid[1])
    white = float(channel.model.angle_random_walk)
    alone = model.gyro_model(None, scale, white)
    look = _look(built, np.inf)
    time = np.cumsum(np.where(look.used, look.duration, 0.0))
    middles = time[-1] * (np.arange(_TEMPERATURES) + 0.5) / _TEMPERATURES
    # The cumulated used time, which does not increase in a gap.
    at = np.searchsorted(time, middles)
    result = limit(
        criterion(alone, "scale_factor", temperatures, rates, requirement.statistic),
        alone,
        motion_time=float(time[-1]),
        temperatures=0.5 * (look.begin + look.end)[at],
        fixed_programme=True,
        max_rate=_fastest(built),
        noise_density=white**2,
    )
    return result.certified, result.reached


def _of_bias(built: AssembledUnit, requirement: UnitRequirement, temperatures: np.ndarray) -> np.ndarray | None:
    """Standard deviations of a bias under white noise and drift, seen continuously."""
    channel = _channel(built, requirement.quantity.removesuffix("_bias"), requirement.axis)
    term = channel.model.term("bias")
    if isinstance(term, Map):
        if term.beyond is not None:
            return None
        bias = term
    else:
        assert isinstance(term, SignalMap)
        bias = model.make_map(term.temperature, prior_std=float(term.std) if term.has_prior else np.inf)
    # Only the processes that act at rate zero.
    processes = channel.model.processes
    at_rest = jax.tree.map(lambda of: of[np.asarray(processes.rate_gain) == 0.0], processes)
    alone = model.gyro_model(bias, None, float(channel.model.angle_random_walk), at_rest)
    decays = alone.processes.decay
    shortest = 1.0 / np.max(decays, initial=1e-12)
    step = min(_LONGEST_S, _SHARE_OF_CORRELATION * shortest)

    def variance(longest: float) -> np.ndarray:
        look = _look(built, longest)
        stands = np.zeros(len(look.start), bool)
        line = trajectory.held(
            look.start, look.duration, np.zeros(len(stands)), look.begin, look.end,
            read=look.used, at_rest=~stands, moving=stands, gap=~look.used,
        )  # fmt: skip
        return information(line, alone).deviations(bias.values(temperatures, 0.0 * temperatures)) ** 2

    # Integrals over steps have less information than instants: halving all further steps adds at most as much as this
    # one.
    coarse, fine = variance(step), variance(0.5 * step)
    return np.sqrt(np.maximum(fine - np.abs(coarse - fine), 0.0))


def _of_signal(built: AssembledUnit, requirement: UnitRequirement, temperatures: np.ndarray) -> np.ndarray | None:
    """Standard deviations from the mean information of all elements."""
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        return None
    kind = "gyro" if requirement.quantity in ("gyro_misalignment", "g_sensitivity") else "accelerometer"
    channels = [
        c for c in built.model.channels if c.kind == kind and requirement.axis in ("worst", "all", AXIS_NAMES[c.axis])
    ]
    most = _most(built, requirement, channels)
    if most is None:
        return None
    name, bound = most
    channel = channels[0]
    term = next(t for t in channel.model.terms if t.name.startswith(name))
    assert isinstance(term, SignalMap)
    nodes, weights = trajectory.quadrature(_NODES)
    look = _look(built, np.inf)
    at = (look.begin[:, None] + (look.end - look.begin)[:, None] * nodes)[look.used]
    functions = term.temperature(at.ravel())
    root = np.sqrt((look.duration[look.used, None] * weights).ravel() * bound) / float(channel.model.angle_random_walk)
    rows = np.concatenate([functions * root[:, None], term.prior_rows()])
    return square_root(rows).deviations(term.temperature(temperatures))


def _most(built: AssembledUnit, requirement: UnitRequirement, channels: list[Channel]) -> tuple[str, float] | None:
    """The quantity's term, and the largest possible mean square of its elements' signals."""
    gravity = float(built.motion.geometry.gravity)
    fastest = _fastest(built)
    # Number of misalignments m_ij of the channels i along the same axis j.
    beside = max(sum(c.axis != j for c in channels) for j in range(3)) / (2 * len(channels))
    return {
        "gyro_misalignment": (MISALIGNMENT.format(""), fastest**2 * beside),
        "accelerometer_misalignment": (MISALIGNMENT.format(""), gravity**2 * beside),
        "accelerometer_scale_factor": (model.SCALE_FACTOR, gravity**2 / len(channels)),
        "second_order": (SECOND_ORDER, gravity**4 / len(channels)),
        "g_sensitivity": ("g_sensitivity", gravity**2 / 3.0),
    }.get(requirement.quantity)


def _fastest(built: AssembledUnit) -> float:
    """The unit's largest rate, rad/s."""
    return max(float(axis.max_rate) for axis in built.spec.rig.table.axis) + EARTH_RATE


def _channel(built: AssembledUnit, kind: str, axis: str) -> Channel:
    """The channel of that kind and axis; for "worst" and "all" the first, since all are alike."""
    return next(c for c in built.model.channels if c.kind == kind and axis in ("worst", "all", AXIS_NAMES[c.axis]))


def _look(built: AssembledUnit, longest: float) -> _Look:
    """The time of the plan's pieces, in steps no longer than `longest`."""
    line = built.motion.line
    parts = np.maximum(1, np.ceil(line.duration / longest * (1.0 - 1e-9))).astype(int)
    piece = np.repeat(np.arange(len(parts)), parts)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)
    edges = np.stack([number, number + 1], axis=1) / parts[piece][:, None]
    temperature = line.temperature(edges, piece)
    duration = line.duration[piece] / parts[piece]
    start, used = line.start[piece] + edges[:, 0] * line.duration[piece], ~np.asarray(line.gap)[piece]
    return _Look(start, duration, temperature[:, 0], temperature[:, 1], used)
