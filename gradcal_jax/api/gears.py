"""Errors of a drive whose angle is read at the motor, scale error and backlash, in the readings of an IMU."""

import numpy as np

from gradcal_jax.estimation import ImuReadings
from gradcal_jax.files.spec.plan import StandardPlan
from gradcal_jax.files.spec.spec_sections import Spec

# The smallest turn that has a direction, rad.
_TURN = np.radians(0.1)


def has_gears(spec: Spec) -> bool:
    """Whether the readings of an IMU have errors of gears that the spec states. Readings along the only axis of a table
    take a scale error for one of the gyro's: there it counts instead."""
    angles, table = [axis.angle for axis in spec.rig.table.axis], spec.rig.table
    if spec.is_one_axis or table.by_gravity or table.place or isinstance(spec.plan, StandardPlan):
        return False
    known = all(angle.scale_error is not None for angle in angles)
    return known and any(angle.scale_error or angle.backlash for angle in angles)


def errors_of_gears(spec: Spec, readings: ImuReadings) -> np.ndarray | None:
    """Changes of the readings `(R, k)` by one standard deviation of each; None without any."""
    if not has_gears(spec) or readings.done.motion.line.rates or readings.sigma is not None:
        return None
    ends, errors = np.stack(readings.done.motion.angles()), list[np.ndarray]()
    for number, axis in enumerate(spec.rig.table.axis):
        angle, sides = ends[..., number], sides_of(ends[..., number])
        for size, error in ((axis.angle.scale_error, angle), (axis.angle.backlash, sides)):
            if size and error is not None:
                errors.append(np.zeros(ends.shape))
                errors[-1][..., number] = float(size) * error
    return readings.of_shown_angles(*np.stack(errors, axis=-1)) if errors else None


def sides_of(angle: np.ndarray) -> np.ndarray | None:
    """The side, ±½, on which an axis stands by its last turn, before and after every piece, `(2, P)`, as its angles;
    None if it turns in one direction only."""
    way = angle[1] - angle[0]
    sign = np.where(np.abs(way) > _TURN, np.sign(way), 0.0)
    turned = np.maximum.accumulate(np.where(sign != 0.0, np.arange(1, len(sign) + 1), 0))
    side = 0.5 * np.concatenate([[0.0], sign])[turned]
    return np.stack([np.concatenate([[0.0], side[:-1]]), side]) if np.ptp(side) == 1.0 else None
