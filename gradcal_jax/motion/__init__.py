"""From moves and temperature programmes to a schedule, its trajectory, and the nodes on which a model is integrated."""

from gradcal_jax.motion.gauss import moving_nodes
from gradcal_jax.motion.motion import Move, rest, turn
from gradcal_jax.motion.programme import Programme, programme
from gradcal_jax.motion.schedule import Schedule, gradient_plan, standard_plan
from gradcal_jax.motion.table_motion import (
    EARTH_RATE,
    Geometry,
    TableMotion,
    Turns,
    body_group,
    body_nodes,
    divided_motion,
    frames,
    lagrange,
    motion_divided_by_plays,
    rotation,
    table_motion,
    turns_of,
)
from gradcal_jax.motion.trajectory import Trajectory, held, quadrature
