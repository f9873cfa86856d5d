"""Errors of a drive whose angle is read at the motor, scale error and backlash, in the readings of an IMU."""

from typing import TYPE_CHECKING

import numpy as np

from gradcal_jax.files.spec.plan import StandardPlan
from gradcal_jax.files.spec.spec_sections import Spec

if TYPE_CHECKING:
    from gradcal_jax.estimation import ImuReadings

# The smallest turn that has a direction, rad.
_TURN = np.radians(0.1)


def gears_of(spec: Spec) -> list[tuple[float, float]]:
    """Standard deviations of scale error and backlash (rad) of every axis, as far as the covariance of readings is to
    contain them; empty: none. Readings along the only axis of a table take a scale error for one of the gyro's: there
    it counts instead."""
    table = spec.rig.table
    if table.by_gravity or isinstance(spec.plan, StandardPlan):
        return []
    angles = [axis.angle for axis in table.axis]
    if any(angle.scale_error is None for angle in angles):
        return []
    sizes = [(float(a.scale_error or 0.0) * (not spec.is_one_axis), float(a.backlash or 0.0)) for a in angles]
    return sizes if np.any(sizes) else []


def errors_of_gears(spec: Spec, readings: "ImuReadings", about: np.ndarray | None) -> np.ndarray | None:
    """Changes of the readings `(R, k)` by one standard deviation of each, of sensors with the parameters `about` (None:
    ideal ones); None without any. (An angle of a milliradian shows misalignments of per cents.)"""
    ends, errors = np.stack(readings.done.motion.angles()), list[np.ndarray]()
    for number, sizes in enumerate(gears_of(spec)):
        angle = ends[..., number]
        for size, error in zip(sizes, (angle, sides_of(angle)), strict=True):
            if size and error is not None:
                errors.append(np.zeros(ends.shape))
                errors[-1][..., number] = size * error
    if not errors:
        return None
    before, after = np.stack(errors, axis=-1)
    return readings.of_shown_angles(before, after, about)


def sides_of(angle: np.ndarray) -> np.ndarray | None:
    """The side, ±½, on which an axis stands by its last turn, before and after every piece, `(2, P)`, as its angles;
    None if it turns in one direction only."""
    way = angle[1] - angle[0]
    sign = np.where(np.abs(way) > _TURN, np.sign(way), 0.0)
    turned = np.maximum.accumulate(np.where(sign != 0.0, np.arange(1, len(sign) + 1), 0))
    side = 0.5 * np.concatenate([[0.0], sign])[turned]
    return np.stack([np.concatenate([[0.0], side[:-1]]), side]) if np.ptp(side) == 1.0 else None
