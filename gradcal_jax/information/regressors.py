"""Regressors: derivatives of the integrated error at a reading with respect to each parameter.

The terms of the model give their increments over every piece (`model.terms`). A reading of an angle sums all pieces
since its origin; one of a held rate has that of its own piece.
"""

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace, running_sum
from gradcal_jax.model import SensorModel
from gradcal_jax.trajectory import Rule, Trajectory, gauss_nodes


def at_readings(line: Trajectory, model: SensorModel, rule: Rule | None = None) -> Float[AnyArray, "P p"]:
    """Regressors of the reading at the end of each piece, rad for each parameter's unit.

    `rule`: integration rule of the terms, for a traced trajectory. Errors: `ValueError` for an encoder's error by
    angle where no angle is read.
    """
    if line.rates and model.harmonics is not None:
        raise ValueError("encoder errors by angle do not apply to the standard method: leave the harmonics out")
    increments = model.columns(gauss_nodes(line, model, rule))
    return increments if line.rates else since_origin(increments, line.gap, line.has_gaps)


def since_origin(
    increments: Float[AnyArray, " P *c"], gap: AnyArray, has_gaps: bool = True
) -> Float[AnyArray, " P *c"]:
    """Running sums over pieces, from the end of the latest gap."""
    xp = namespace(increments)
    rows = running_sum(increments)
    if not has_gaps:
        return rows
    latest = xp.maximum.accumulate(xp.where(gap, np.arange(len(rows)), -1))
    origin = rows[xp.maximum(latest, 0)]
    return rows - xp.where(xp.reshape(latest, (-1,) + (1,) * (rows.ndim - 1)) >= 0, origin, 0.0)
