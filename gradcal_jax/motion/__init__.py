"""How table and temperature move: moves and a programme of the chamber in, a `TableMotion` and its nodes out.

* `motion`: moves by their smooth pieces. `programme`: soaks, ramps, and the temperature of a lagging sensor.
* `schedule`: a plan as arrays. `trajectory`: its pieces in time, rate and temperature.
* `gauss`: how pieces are integrated, and where functions of temperature are not smooth.
* `table_motion`: the axis that each piece turns, the geometry, and the nodes of the body.
"""

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
