"""Errors of a drive whose angle is read at the motor, scale error and backlash, in the readings of an IMU."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gradcal_jax.arrays import AnyArray, namespace, placed
from gradcal_jax.information.imu_rows import Segments, encoder_rows, rows_of_angles, segments_of
from gradcal_jax.model import BodyNodes, ImuModel
from gradcal_jax.model.terms import UNTOLD_BEGIN, sides
from gradcal_jax.motion import TableMotion

BACKLASH: Final = "backlash of the table's drive"
SCALE_OF_ANGLE: Final = "scale of the table's angle"


def errors_of_angles(motion: TableMotion, gears: Sequence[tuple[float, float]]) -> list[tuple[str, AnyArray]]:
    """What one standard deviation of each error changes in the angles (rad) before and after every piece, `(2, P, L)`,
    with the name of its source; of known numbers, those that change anything."""
    xp, errors = namespace(motion.angles()), list[tuple[str, AnyArray]]()
    ends = xp.stack(motion.angles())
    for number, (scale, lash) in enumerate(gears):
        angle = ends[..., number]
        side = xp.stack(sides(*angle))
        of_axis = (
            (SCALE_OF_ANGLE, scale * angle),
            (BACKLASH, lash * side),
            (BACKLASH, xp.where(side == 0.0, UNTOLD_BEGIN * lash, 0.0)),
        )
        for name, error in of_axis:
            if xp is not np or np.ptp(error) > 0.0:
                errors.append((name, placed(ends.shape, ((..., number), error))))
    return errors


def rows_of_gears(
    motion: TableMotion,
    model: ImuModel,
    nodes: BodyNodes,
    gears: Sequence[tuple[float, float]],
    at: Segments | None = None,
) -> tuple[list[str], AnyArray]:
    """What they change in the rows of a plan, `(R, k)`, and what each is. `at`: as of `imu_system`."""
    errors, at = errors_of_angles(motion, gears), at or segments_of(motion, model)
    if not errors:
        return [], np.zeros((len(at.row_segment), 0))
    before, after = namespace(errors[0][1]).stack([error for _, error in errors], axis=-1)
    return [name for name, _ in errors], rows_of_angles(at, encoder_rows(motion, model, nodes, at), before, after)
