"""The proven limit on any plan that does what a spec's plan is allowed to, and how near that plan comes."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.assemble.build import Assembled, assemble
from gradcal_jax.assemble.knowledge import UNIT_OF, box
from gradcal_jax.assemble.measure import design_of
from gradcal_jax.assemble.prediction import predict
from gradcal_jax.assemble.structures import LEAST_TURN, largest_rate, motion_time
from gradcal_jax.design import (
    PRIOR_OF_WALK,
    criterion,
    gated_noise_density,
    least_noise_density,
    limit,
    scale_factor_floor,
)
from gradcal_jax.files import Spec
from gradcal_jax.files.design import TIMES
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.files.schedule import GradientSchedule, StandardSchedule

# Temperatures in each turn at the table (with six, the headline's limit is 0.06 % lower), or over a ramp.
_IN_A_WINDOW = 2
# Times in each turn at the table at which a process that multiplies the rate is looked at.
_DENSE = 6
_OVER_A_RAMP = 48
_MOST_WINDOWS = 40


class PlanLimit(NamedTuple):
    """No plan leaves less than `certified` (`unit`) of a requirement; `reached`: what the relaxed problem attains.

    `value`: what the spec's plan leaves (None: not observable); `efficiency`: certified over value. `relaxed`: what
    the proof lets a plan do that the rig does not, in words.
    """

    name: str
    statistic: str
    unit: str
    certified: float
    reached: float
    value: float | None
    efficiency: float | None
    relaxed: tuple[str, ...]


def limits(spec: Spec, *, motion: float | None = None) -> list[PlanLimit]:
    """The limit of every scale-factor requirement of a gradient plan with motion.

    `motion` s: of another time without soaks than the plan or [design] has; values and efficiencies are the plan's.
    Errors: `ValueError` where there is no such requirement, or the plan is of another kind.
    """
    if isinstance(spec.schedule, StandardSchedule) or spec.schedule.cycle is None:
        raise ValueError("a limit is proven for gradient plans with moves; this plan has none")
    wanted = [r for r in spec.requirement if r.quantity == "scale_factor"]
    if not wanted:
        raise ValueError("a limit is proven for the scale factor; the spec has no requirement on it")
    built = assemble(spec)
    predicted = {row.name: row for row in predict(spec).requirements if row.axis == built.channels[0]}
    window = _window(spec, built, motion)
    return [window.limit(r, predicted[r.name]) for r in wanted]


class _Window(NamedTuple):
    """When and where the axis may turn, and the noise that its motion meets at least.

    `times` s and the temperatures `followed` then, dense; none where the programme is free.
    """

    spec: Spec
    built: Assembled
    time: float
    temperatures: np.ndarray
    fixed: bool
    density: float
    times: np.ndarray
    followed: np.ndarray
    relaxed: tuple[str, ...]

    def limit(self, requirement: Requirement, row) -> PlanLimit:
        temperature, rate = box(requirement)
        model = self.built.model
        asked = criterion(model, requirement.quantity, temperature, rate, requirement.statistic)
        sure = scale_factor_floor(model, self.times, self.followed, temperature)
        found = limit(
            eqx.tree_at(lambda c: c.beyond, asked, asked.beyond + np.repeat(sure, len(rate))),
            model,
            motion_time=self.time,
            temperatures=self.temperatures,
            fixed_programme=self.fixed,
            max_rate=largest_rate(self.spec, []),
            noise_density=self.density,
            prior_share=PRIOR_OF_WALK if np.any(sure) else 1.0,
        )
        unit, factor = UNIT_OF[requirement.quantity]
        left, certified = row.decisive, found.certified * factor
        efficiency = None if left is None else certified / left
        return PlanLimit(
            requirement.name,
            requirement.statistic,
            unit,
            certified,
            found.reached * factor,
            left,
            efficiency,
            self.relaxed,
        )


def _window(spec: Spec, built: Assembled, motion: float | None) -> _Window:
    schedule = spec.gradient_schedule
    design = spec.design
    free = set() if design is None else set(design.free)
    cycle = schedule.cycle
    assert cycle is not None
    # A cycle that fills the ramp, as a recipe's does, is made for that ramp alone.
    as_is = design is None or design.minimise in TIMES or 2.0 * cycle.duration > schedule.motion
    time = motion or (schedule.motion if as_is else motion_time(spec, design_of(spec)))
    ramp = [s for s in schedule.segments if s.used and s.kind == "ramp"]
    start, end_temperature = ramp[0].temperature_start, ramp[-1].temperature_end
    windows = _windows(schedule, time)
    # A cycle of another length may have a little more or less of the same share.
    own = sum(move.repeat * move.duration for move in cycle.moves if not move.other_axes)
    total = max(sum(end - begin for begin, end in windows), time * own / cycle.duration)
    reference = built.model.reference
    rests = [m.read_every for m in cycle.moves if m.read_every is not None]
    # Standstills are a turn apart; the plan's own turns may be shorter than those that are searched.
    apart = min([LEAST_TURN, *(m.duration for m in cycle.moves if not m.is_rest)])
    spacing = min([*rests, cycle.other_read_every or np.inf, apart])
    relaxed = ["acceleration and travel", "readings are taken on the move, too"]
    if len(built.channels) > 1:
        relaxed.append("the axis turns whenever any axis does")
    tied = "cycle" not in free and len(windows) <= _MOST_WINDOWS
    if tied and float(reference.reading_noise) > 0.0:
        density = gated_noise_density(built.model, spacing, windows)
    else:
        density = least_noise_density(built.model, spacing)
        if not tied:
            relaxed.append("the axis has its time at the table when it likes")
    if float(reference.standstill_offset) > 0.0:
        # An offset is one draw a standstill.
        other = eqx.tree_at(lambda m: m.reference.reading_noise, built.model, reference.standstill_offset)
        density = max(density, least_noise_density(other, apart))
        relaxed.append(f"standstills as little as {apart:.3g} s apart")
    fixed = "gradient" not in free
    times = seen = np.zeros(0)
    if not fixed:
        temperatures = np.linspace(start, end_temperature, _OVER_A_RAMP)
        relaxed.append("the time is spread over the temperatures as is best")
        if np.any(np.asarray(built.model.processes.rate_gain)):
            relaxed.append("errors that multiply the rate are left out, but for constant ones")
    else:
        slope = (end_temperature - start) / time
        followed = lambda t: start + slope * _lagged(t, float(spec.sensor.thermal_lag or 0.0))  # noqa: E731
        if tied:
            temperatures = followed(_inside(windows, _IN_A_WINDOW))
        else:
            temperatures = followed(time * (np.arange(_OVER_A_RAMP) + 0.5) / _OVER_A_RAMP)
        # Wherever a cycle of free length puts the axis's turns, they lie in the ramp.
        times = _inside(windows if tied else [(0.0, time)], _DENSE if tied else _DENSE * _OVER_A_RAMP)
        seen = followed(times)
    return _Window(spec, built, total, temperatures, fixed, density, times, seen, tuple(relaxed))


def _inside(windows: list[tuple[float, float]], count: int) -> np.ndarray:
    """The middles of `count` equal parts of each window."""
    share = (np.arange(count) + 0.5) / count
    return np.concatenate([begin + (end - begin) * share for begin, end in windows])


def _lagged(t: np.ndarray, lag: float) -> np.ndarray:
    """The time at which a ramp from equilibrium was where its follower, `lag` s behind it, is at t."""
    return t + lag * np.expm1(-t / lag) if lag > 0.0 else t


def _windows(schedule: GradientSchedule, time: float) -> list[tuple[float, float]]:
    """When the axis has the table (begin, end; s after the ramp's begin)."""
    cycle = schedule.cycle
    assert cycle is not None
    period = cycle.duration
    visits = int((time + period - cycle.moving + 1e-6) // period)
    found: list[tuple[float, float]] = []
    for begin in period * np.arange(visits):
        here = float(begin)
        found.append((here, here))
        for move in cycle.moves:
            there = here + move.repeat * move.duration
            found.append((there, there)) if move.other_axes else found.append((found.pop()[0], there))
            here = there
    return [(begin, end) for begin, end in found if end > begin]
