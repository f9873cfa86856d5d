"""Tests of figures of a spec that are no parameters of an estimate: the latitude of the site, and errors of the table's
angles that the spec says nothing of, backlash and waves by angle.

Each is one column or two beside those of the model: what remains of them after the fit of all parameters shows in the
residuals, or does not. Where a plan's parameters take them up there is nothing to test: two turns to and fro with
backlash are a scale-factor error.
"""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.api.imu_residual import imu_residual
from gradcal_jax.estimation import (
    Components,
    ImuEstimate,
    ImuReadings,
    Test,
    chi_squared,
    chi_squared_test,
    components,
)
from gradcal_jax.files.base.contracts import RequirementRow
from gradcal_jax.files.spec.spec_sections import Spec
from gradcal_jax.information import Posterior

# Standard deviation of the latitude, rad, above which readings say nothing about it.
_LATITUDE: Final = 0.5
# Waves over a turn that encoders and discs off their centres have.
_ORDERS: Final = (1, 2)
# The smallest turn that has a direction, rad.
_TURN: Final = np.radians(0.1)
# Standard deviation of an error of the table's angles, rad, above which it is not tested.
_ANGLE: Final = np.radians(0.2)
# Backlash, rad, that good gears may have; and the share of a requirement's error from which on it is reported.
_LITTLE: Final = np.radians(0.01)
_MATTERS: Final = 0.5


class FigureTest(NamedTuple):
    """Test of a figure of the spec, with its name and the sentence of a failure."""

    name: str
    test: Test
    sentence: str


def figure_tests(spec: Spec, readings: ImuReadings, solution: ImuEstimate, excess: float) -> Iterator[FigureTest]:
    """All of them; `excess`: the factor by which the residuals exceed the spec's noise, which is not backlash."""
    yield from _latitude(spec, readings, solution)
    if not _shows_angles(readings):
        return
    for number, axis in enumerate(spec.rig.table.axis):
        yield from _backlash(number, axis.name, readings, solution, excess)
        orders = sorted(set(_ORDERS) - {wave.order for wave in axis.angle.harmonics})
        yield from _waves(number, axis.name, orders, readings, solution, excess)


def backlash_sentences(
    built: BuiltImu, readings: ImuReadings, solution: ImuEstimate, rows: Sequence[RequirementRow]
) -> Iterator[str]:
    """A sentence for each axis whose backlash the parameters take up, where a little of it would matter; `rows`: of the
    spec's requirements, judged."""
    if not _shows_angles(readings):
        return
    known = solution.known.spread
    for number, axis in enumerate(built.spec.rig.table.axis):
        column = _by_backlash(number, readings)
        if column is None or _is_known(_beside_scale(number, column, readings, solution), _LITTLE / 2.0):
            continue
        shift = Posterior(_LITTLE * known @ (known.T @ (solution.white.rows.T @ column)), np.zeros((len(known), 0)))
        changes = [imu_residual(built, shift, requirement).statistic() for requirement in built.spec.requirement]
        shares = [c / r.decisive if c and r.decisive else 0.0 for c, r in zip(changes, rows, strict=True)]
        worst = int(np.argmax(shares)) if shares else 0
        if shares and shares[worst] > _MATTERS:
            yield (
                f"the log cannot show backlash of the axis {axis.name}, and the uncertainty does not include it: "
                f"{np.degrees(_LITTLE):.2g} deg of backlash would change '{rows[worst].name}' by {changes[worst]:.2g} "
                f"{rows[worst].unit}. If the drive has backlash, read the angle at the axis itself, or approach every "
                "stop from the same side"
            )


def _shows_angles(readings: ImuReadings) -> bool:
    return not (readings.done.motion.line.rates or readings.free or readings.sigma is not None)


def _beside_scale(number: int, columns: np.ndarray, readings: ImuReadings, solution: ImuEstimate) -> Components:
    """Components on the columns `(n, k)` of errors of an axis's angle, beside an unknown scale error of this angle,
    which is no parameter: 1 ppm of it is 0.001 deg after three turns."""
    angles = np.zeros((2, *readings.done.motion.angles()[0].shape, 1))
    angles[:, :, number, 0] = np.stack(readings.done.motion.angles())[..., number]
    both = np.concatenate([columns, readings.by_shown_angles(angles[0], angles[1])], axis=1)
    return components(solution.white, both, np.arange(both.shape[1]) < columns.shape[1])


def _is_known(of: Components, std: float) -> bool:
    """Whether the readings tell an error of angle, rad, to within a standard deviation."""
    return bool(len(of.gains) and of.gains[0] > std**-2)


def _latitude(spec: Spec, readings: ImuReadings, solution: ImuEstimate) -> Iterator[FigureTest]:
    """Of a wrong latitude the vertical rate resembles a sensitivity to g, and only the horizontal one contradicts it.
    Nothing where the readings hardly tell it from the parameters."""
    if spec.rig.site.is_unknown:
        return
    column = readings.by_latitude(solution.parameters)
    of = components(solution.white, column)
    if not len(of.gains) or of.gains[0] < _LATITUDE**-2:
        return
    stated, std = np.degrees(spec.rig.site.latitude_rad), np.degrees(of.gains[0] ** -0.5)
    seen = stated + np.degrees(float(column[:, 0] @ solution.estimate.residuals) / of.gains[0])
    yield FigureTest(
        "latitude of the site",
        chi_squared(of),
        f"the gyros observe the Earth's rate at a latitude of about {seen:.0f} ± {max(std, 1.0):.0f} deg, but the spec "
        f"states {stated:.4g} deg: is [rig.site] latitude correct?",
    )


def _by_backlash(number: int, readings: ImuReadings) -> np.ndarray | None:
    """The whitened column `(n, 1)` of the backlash of an axis, 1/rad; None if the axis turns in one direction only."""
    before, after = readings.done.motion.angles()
    way = after[:, number] - before[:, number]
    sign = np.where(np.abs(way) > _TURN, np.sign(way), 0.0)
    # The side at which the axis stands after each piece: of its last turn.
    turned = np.maximum.accumulate(np.where(sign != 0.0, np.arange(1, len(sign) + 1), 0))
    side = 0.5 * np.concatenate([[0.0], sign])[turned]
    if np.ptp(side) < 1.0:
        return None
    error = np.zeros((2, *before.shape, 1))
    error[:, :, number, 0] = np.concatenate([[0.0], side[:-1]]), side
    return readings.by_shown_angles(error[0], error[1])


def _backlash(
    number: int, axis: str, readings: ImuReadings, solution: ImuEstimate, excess: float
) -> Iterator[FigureTest]:
    column = _by_backlash(number, readings)
    if column is None or not _is_known(of := _beside_scale(number, column, readings, solution), _ANGLE):
        return
    size, std = abs(float(of.y[0, 0])) * of.gains[0] ** -0.5, excess * of.gains[0] ** -0.5
    yield FigureTest(
        f"backlash of the axis {axis}",
        chi_squared_test(chi_squared(of).statistic / excess**2, 1),
        f"axis {axis}: the table's angles after turns in one direction differ by {np.degrees(size):.2g} ± "
        f"{np.degrees(std):.1g} deg from those after turns in the other direction: does the drive have backlash? Read "
        "the angle at the axis itself, or approach every stop from the same side",
    )


def _waves(
    number: int, axis: str, orders: Sequence[int], readings: ImuReadings, solution: ImuEstimate, excess: float
) -> Iterator[FigureTest]:
    ends = np.stack(readings.done.motion.angles())
    for order in orders:
        error = np.zeros((*ends.shape, 2))
        angle = order * ends[..., number]
        error[:, :, number] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        of = _beside_scale(number, readings.by_shown_angles(error[0], error[1]), readings, solution)
        if not _is_known(of, _ANGLE):
            continue
        seen = np.linalg.norm(of.y[:, 0] / np.sqrt(of.gains))
        yield FigureTest(
            f"waves of the angle of the axis {axis}, order {order}",
            chi_squared_test(chi_squared(of).statistic / excess**2, len(of.gains)),
            f"axis {axis}: the table's angle has an error of about {np.degrees(seen):.2g} deg that repeats {order} "
            f"times per turn, but the spec states no such error: add harmonics of order {order} to the angle of "
            "this axis in [rig.table]",
        )
