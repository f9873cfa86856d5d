"""Motion and temperature programmes, the standard and the gradient plan, and the timeline that a plan becomes."""

from gradcal_jax.plans.motion import Move, rest, turn
from gradcal_jax.plans.plan import GradientPlan, Plan, StandardPlan, gradient_plan, standard_plan
from gradcal_jax.plans.programme import Programme, programme
from gradcal_jax.plans.timeline import Timeline

__all__ = [
    "GradientPlan",
    "Move",
    "Plan",
    "Programme",
    "StandardPlan",
    "Timeline",
    "gradient_plan",
    "programme",
    "rest",
    "standard_plan",
    "turn",
]
