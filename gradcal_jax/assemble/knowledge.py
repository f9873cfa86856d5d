"""What is known after a spec's plan, on its requirements' boxes."""

from typing import Final, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gradcal_jax import plans
from gradcal_jax.assemble.build import Assembled
from gradcal_jax.errormodel import GyroModel
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.information import Posterior, information, posterior, residual, unweighted
from gradcal_jax.units import DEG_PER_H as DEG_PER_H
from gradcal_jax.units import DEG_PER_S as DEG_PER_S
from gradcal_jax.units import PPM as PPM

UNIT_OF: Final[dict[str, tuple[Literal["ppm", "deg/h"], float]]] = {
    "scale_factor": ("ppm", PPM),
    "bias": ("deg/h", DEG_PER_H),
}


# In parts that are compiled once each: the timeline serves every model, the survey and the unweighted estimator.
@eqx.filter_jit
def _timeline(plan: plans.Plan, channel: str, thermal_lag) -> plans.Timeline:
    return plan.timeline(channel, thermal_lag)


_information = eqx.filter_jit(information)


def _line(built: Assembled, channel: str) -> plans.Timeline:
    return _timeline(built.plan, channel, None if built.thermal_lag is None else np.asarray(built.thermal_lag))


def knowledge(built: Assembled, channel: str = "x", model: GyroModel | None = None) -> Posterior:
    """What is known after the plan, by the estimator that the spec names. `model` replaces the assembled one."""
    model = built.model if model is None else model
    line, section = _line(built, channel), built.spec.plan
    if isinstance(section, StandardPlanSection) and section.estimator == "least squares":
        return unweighted(line, model)
    return posterior(_information(line, model))


class Survey(NamedTuple):
    """Where a plan takes a sensor: coldest and warmest (°C), and its fastest rate (rad/s), on a grid of each piece."""

    coldest: float
    warmest: float
    fastest: float


@eqx.filter_jit
def _survey(line: plans.Timeline):
    moving = line.moving_pieces.values
    grid = jnp.broadcast_to(jnp.linspace(0.0, 1.0, 33), (len(moving), 33))
    ends = line.temperature(jnp.broadcast_to(jnp.array([0.0, 1.0]), (line.piece_count, 2)))
    return jnp.min(ends), jnp.max(ends), jnp.max(jnp.abs(line.rate(grid, moving)), initial=0.0)


def survey(built: Assembled, channel: str = "x") -> Survey:
    """Where the plan takes the sensor on one axis."""
    return Survey(*(float(v) for v in _survey(_line(built, channel))))


def residual_map(
    built: Assembled, known: Posterior, requirement: Requirement
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperatures (°C), rates (deg/s) and the residual `(n_T, n_ω)` in ppm or deg/h, on a requirement's box."""
    cold, warm = requirement.temperature
    temperatures = np.linspace(float(cold), float(warm), requirement.grid[0])
    rates = np.zeros(1)
    if requirement.quantity == "scale_factor":
        slow, fast = requirement.rate
        rates = np.linspace(float(slow), float(fast), requirement.grid[1])
    values = residual(known, built.model, requirement.quantity, temperatures, rates)
    return temperatures, rates * DEG_PER_S, values * UNIT_OF[requirement.quantity][1]
