"""Tests of figures of a spec that are no parameters of an estimate: the latitude of the site, and errors of the table's
angles that the spec says nothing of, backlash and waves by angle.

Each is one column or two beside those of the model: what remains of them after the fit of all parameters shows in the
residuals, or does not. Where a plan's parameters take them up there is nothing to test: two turns to and fro with
backlash are a scale-factor error.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.estimation import (
    Components,
    ImuEstimate,
    ImuReadings,
    Test,
    chi_squared,
    chi_squared_test,
    components,
)
from gradcal_jax.information import Posterior
from gradcal_jax.information.gears import sides_of
from gradcal_jax.information.imu_residual import imu_residual
from gradcal_jax.model.imu_build import BuiltImu
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import RequirementRow

# Standard deviation of the latitude, rad, above which readings say nothing about it.
_LATITUDE: Final = 0.5
# Waves over a turn that encoders and discs off their centres have.
_ORDERS: Final = (1, 2)
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


class AngleColumns(NamedTuple):
    """Whitened columns of the rows used with respect to errors of one axis's angles: `backlash` `(n, 1)` (None if the
    axis turns in one direction only), `waves` `(n, 2)` by order, `scale` `(n, 1)`."""

    axis: str
    backlash: np.ndarray | None
    waves: Mapping[int, np.ndarray]
    scale: np.ndarray

    def components(self, columns: np.ndarray, solution: ImuEstimate) -> Components:
        """Components on some of the columns, beside an unknown scale error, which is no parameter: 1 ppm of it is
        0.001 deg after three turns."""
        both = np.concatenate([columns, self.scale], axis=1)
        return components(solution.white, both, np.arange(both.shape[1]) < columns.shape[1])


def angle_columns(spec: Spec, readings: ImuReadings) -> list[AngleColumns]:
    """Of every axis of the table, without the waves that the spec has; none where no angle is read at rest."""
    if readings.done.motion.line.rates or readings.free:
        return []
    ends = np.stack(readings.done.motion.angles())
    errors, places = [], []
    for number, axis in enumerate(spec.rig.table.axis):
        angle, orders = ends[..., number], sorted(set(_ORDERS) - {wave.order for wave in axis.angle.harmonics})
        waves = [wave(order * angle) for order in orders for wave in (np.cos, np.sin)]
        sides = sides_of(angle)
        own = [angle, *waves, *(() if sides is None else (sides,))]
        places.append((axis.name, orders, sides is not None, len(errors)))
        for error in own:
            errors.append(np.zeros(ends.shape))
            errors[-1][..., number] = error
    if not errors:
        return []
    before, after = np.stack(errors, axis=-1)
    every, found = readings.by_shown_angles(before, after), list[AngleColumns]()
    for name, orders, both_ways, at in places:
        waves = {order: every[:, at + 1 + 2 * k : at + 3 + 2 * k] for k, order in enumerate(orders)}
        last = at + 1 + 2 * len(orders)
        found.append(AngleColumns(name, every[:, last : last + 1] if both_ways else None, waves, every[:, at : at + 1]))
    return found


def figure_tests(
    spec: Spec, readings: ImuReadings, solution: ImuEstimate, angles: Sequence[AngleColumns], excess: float
) -> Iterator[FigureTest]:
    """All of them; `excess`: the factor by which the residuals exceed the spec's noise, which is not backlash."""
    yield from _latitude(spec, readings, solution)
    for of_axis in angles:
        yield from _backlash(of_axis, solution, excess)
        yield from _waves(of_axis, solution, excess)


def backlash_sentences(
    built: BuiltImu, solution: ImuEstimate, angles: Sequence[AngleColumns], rows: Sequence[RequirementRow]
) -> Iterator[str]:
    """A sentence for each axis whose backlash the parameters take up, where a little of it would matter and the spec
    does not state it; `rows`: of the spec's requirements, judged."""
    known = solution.known.spread
    for number, of_axis in enumerate(angles):
        column = of_axis.backlash
        if built.spec.rig.table.axis[number].angle.backlash is not None or column is None:
            continue
        if _is_known(of_axis.components(column, solution), _LITTLE / 2.0):
            continue
        shift = Posterior(_LITTLE * known @ (known.T @ (solution.white.rows.T @ column)), np.zeros((len(known), 0)))
        changes = [imu_residual(built, shift, requirement).statistic() for requirement in built.spec.requirement]
        shares = [c / r.decisive if c and r.decisive else 0.0 for c, r in zip(changes, rows, strict=True)]
        worst = int(np.argmax(shares)) if shares else 0
        if shares and shares[worst] > _MATTERS:
            yield (
                f"the log cannot show backlash of the axis {of_axis.axis}: {np.degrees(_LITTLE):.2g} deg of it would "
                f"change '{rows[worst].name}' by {changes[worst]:.2g} {rows[worst].unit}, and "
                f"{_counted_backlash(built.spec, number)}. State the backlash of the drive (angle.backlash), read the "
                "angle at the axis itself, or approach every stop from the same side"
            )


def _counted_backlash(spec: Spec, number: int) -> str:
    """What an uncertainty includes of the backlash of an axis that the spec does not state."""
    own, typical = spec.rig.table.axis[number].angle, with_typical(spec).rig.table.axis[number].angle
    if typical.backlash:
        return f"the uncertainty includes {typical.backlash} (1σ), typical of the class"
    if own.scale_error is None and typical.scale_error:
        return f"the uncertainty includes the scale error of gears with their backlash, {typical.scale_error}"
    return "the uncertainty does not include it"


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


def _backlash(angles: AngleColumns, solution: ImuEstimate, excess: float) -> Iterator[FigureTest]:
    column, axis = angles.backlash, angles.axis
    if column is None or not _is_known(of := angles.components(column, solution), _ANGLE):
        return
    size, std = abs(float(of.y[0, 0])) * of.gains[0] ** -0.5, excess * of.gains[0] ** -0.5
    yield FigureTest(
        f"backlash of the axis {axis}",
        chi_squared_test(chi_squared(of).statistic / excess**2, 1),
        f"axis {axis}: the table's angles after turns in one direction differ by {np.degrees(size):.2g} ± "
        f"{np.degrees(std):.1g} deg from those after turns in the other direction: does the drive have backlash? Read "
        "the angle at the axis itself, or approach every stop from the same side",
    )


def _waves(angles: AngleColumns, solution: ImuEstimate, excess: float) -> Iterator[FigureTest]:
    for order, columns in angles.waves.items():
        of = angles.components(columns, solution)
        if not _is_known(of, _ANGLE):
            continue
        size = np.linalg.norm(of.y[:, 0] / np.sqrt(of.gains))
        yield FigureTest(
            f"waves of the angle of the axis {angles.axis}, order {order}",
            chi_squared_test(chi_squared(of).statistic / excess**2, len(of.gains)),
            f"axis {angles.axis}: the table's angle has an error of about {np.degrees(size):.2g} deg that repeats "
            f"{order} times per turn, but the spec states no such error: add harmonics of order {order} to the angle "
            "of this axis in [rig.table]",
        )
