"""Tests of what a model lacks: columns that are added beside those of a fit.

Orthogonal projections remove all estimated parameters, with their priors, from the whitened columns X of what is tested
and from the data z. Then with `X = U S Vᵀ`, `y = Uᵀz` is `N(0, 1 + σ²m)` component by component, `m = S²` being the
gains, if the coefficients are `N(0, σ²)`; if the model is true, `Σ y²` is χ². If a plan's parameters take up the
columns there is nothing to test.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.calibration.correction import temperature_slope
from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.imu_readings import ImuReadings
from gradcal_jax.estimation.imu_solve import ImuEstimate, Whitened, factored
from gradcal_jax.information.imu_rows import rows_of_terms
from gradcal_jax.information.posterior import OBSERVABLE
from gradcal_jax.information.unseen import Answers
from gradcal_jax.model import GradientOfBias
from gradcal_jax.spec.spec_sections import Spec

# Components whose gain is below this share of the largest gain would only add noise to the test.
_SEEN: Final = 1e-4
# Standard deviation of the latitude, rad, above which readings say nothing about it.
_LATITUDE: Final = 0.5
# Waves over a turn that encoders and discs off their centres have, and the standard deviation (rad) above which an
# error of the table's angles is not tested.
_ORDERS: Final = (1, 2)
_ANGLE: Final = np.radians(0.2)
# Step of finite differences, rad.
_SMALL_TURN: Final = 1e-5


class Components(NamedTuple):
    """`y` `(k,)` with the gains `(k,)` (per squared unit of a coefficient)."""

    y: np.ndarray
    gains: np.ndarray

    def test(self, excess: float = 1.0) -> Test:
        """Whether the columns explain more than chance; `excess`: the factor by which the noise exceeds the spec's."""
        return chi_squared_test(float(np.sum(self.y**2)) / excess**2, len(self.gains))

    def tells(self, std: float) -> bool:
        """Whether the readings tell a coefficient to within a standard deviation."""
        return bool(len(self.gains) and self.gains[0] > std**-2)


class Beside:
    """What a fit leaves of columns and of its data."""

    def __init__(self, white: Whitened) -> None:
        self.known = factored(np.concatenate([white.rows, white.prior])).basis
        self.left = self.of(white.data[:, None])

    def of(self, columns: np.ndarray) -> np.ndarray:
        """`(n + q, k)`: columns `(n, k)` without what the fit takes up."""
        both = np.pad(columns, ((0, len(self.known) - len(columns)), (0, 0)))
        # Projected twice, since the remainder is small beside the removed part.
        both = both - self.known @ (self.known.T @ both)
        return both - self.known @ (self.known.T @ both)

    def components(self, columns: np.ndarray, others: np.ndarray | None = None, seen: float = _SEEN) -> Components:
        """Components on whitened columns `(n, k)`; `others` `(n, j)` are estimated, too, without a prior."""
        hidden, left = self.of(columns), self.left
        if others is not None:
            taken = factored(self.of(others)).basis
            hidden, left = (of - taken @ (taken.T @ of) for of in (hidden, left))
        directions, sizes, _ = np.linalg.svd(hidden, full_matrices=False)
        gains = sizes**2
        used = gains > max(seen * np.max(gains, initial=0.0), np.finfo(float).tiny)
        return Components((directions[:, used].T @ left)[:, 0], gains[used])


def halves_test(white: Whitened, half: np.ndarray) -> Test:
    """Whether readings in one `half` `(n,)`, such as those while heating, ask for other parameters than the others:
    their own columns are added beside those of all, without priors, so that the statistic is χ²_AB − χ²_A − χ²_B."""
    alone = white._replace(prior=white.prior[:0])
    columns = alone.rows * half[:, None]
    length = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(length > 0.0, length, 1.0)
    return Beside(alone).components(columns, seen=OBSERVABLE**2).test()


class Whitener:
    """Whitens further columns of the rows of a fit, about the nominal table."""

    def __init__(self, readings: ImuReadings) -> None:
        self.readings, self.nodes = readings, readings.nominal()
        self.at = readings.segments
        self.white = readings.whitener(readings.linear(None)[0])

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """`(n, k)`, of the rows used, of columns `(R, k)` of all rows."""
        return self.white(self.readings.by_steps(rows))

    def answers(self, solution: ImuEstimate) -> Answers:
        """By how much the estimate is off for one unit of what it does not know; see `information.unseen`."""
        readings, numbers = self.readings, range(len(self.readings.model.channels))
        # What the readings are more if the maps have the temperature of a second before.
        before = readings.temperature_c - temperature_slope(readings.temperature_c, readings.log.time_s)
        late = readings.at(before, solution.parameters) - readings.expected(solution.parameters)
        unit = GradientOfBias(std=np.inf)
        columns = [rows_of_terms(readings.model, self.nodes, self.at, [(k, unit) for k in numbers])]
        columns += [(late * (self.at.row_channel == k))[:, None] for k in numbers]
        along = solution.white.rows.T @ self(np.concatenate(columns, axis=1))
        spread = solution.known.spread
        answers = list((spread @ (spread.T @ along)).T)
        return Answers(answers[: len(numbers)], answers[len(numbers) :])

    def by_latitude(self, parameters: np.ndarray) -> np.ndarray:
        """The derivatives `(R, 1)` with respect to the site's latitude, 1/rad; not whitened."""
        readings, motion = self.readings, self.readings.done.motion
        moved = eqx.tree_at(lambda m: m.geometry.latitude, motion, motion.geometry.latitude + _SMALL_TURN)
        there = readings._replace(done=readings.done._replace(motion=moved), known={})
        return ((there.expected(parameters) - readings.expected(parameters)) / _SMALL_TURN)[:, None]


def added_tests(
    spec: Spec, whiten: Whitener, solution: ImuEstimate, excess: float
) -> Iterator[tuple[str, tuple[Test, str]]]:
    """By name, the tests of what no other test of the fit was seen to find, with the sentence of a failure: a wrong
    latitude, and waves of the table's angles.
    `excess`: the factor by which the residuals exceed the spec's noise, which is no wave."""
    beside = Beside(solution.white)
    if not spec.rig.site.is_unknown:
        # A wrong latitude's vertical rate resembles a sensitivity to g; only the horizontal one contradicts it.
        column = whiten(whiten.by_latitude(solution.parameters))
        of = beside.components(column)
        if of.tells(_LATITUDE):
            stated, std = np.degrees(spec.rig.site.latitude_rad), np.degrees(of.gains[0] ** -0.5)
            seen = stated + np.degrees(float(column[:, 0] @ solution.residuals) / of.gains[0])
            sentence = (
                f"the gyros observe the Earth's rate at a latitude of about {seen:.0f} ± {max(std, 1.0):.0f} deg, but "
                f"the spec states {stated:.4g} deg: is [rig.site] latitude correct?"
            )
            yield "latitude of the site", (of.test(), sentence)
    yield from _wave_tests(spec, whiten, beside, excess)


def _wave_tests(spec: Spec, whiten: Whitener, beside: Beside, excess: float) -> Iterator[tuple[str, tuple[Test, str]]]:
    """Of every axis of the table, of the waves that the spec lacks, beside an unknown scale error, which is no
    parameter: 1 ppm of it is 0.001 deg after three turns. None where no angle is read at rest."""
    motion = whiten.readings.done.motion
    if motion.line.rates or whiten.readings.free:
        return
    ends = np.stack(motion.angles())
    for number, axis in enumerate(spec.rig.table.axis):
        angle = ends[..., number]
        for order in sorted(set(_ORDERS) - {wave.order for wave in axis.angle.harmonics}):
            errors = np.zeros((*ends.shape, 3))
            errors[..., number, :] = np.stack([angle, np.cos(order * angle), np.sin(order * angle)], axis=-1)
            columns = whiten(whiten.readings.of_shown_angles(errors[0], errors[1]))
            wave = beside.components(columns[:, 1:], columns[:, :1])
            if not wave.tells(_ANGLE):
                continue
            size = np.degrees(np.linalg.norm(wave.y / np.sqrt(wave.gains)))
            sentence = (
                f"axis {axis.name}: the table's angle has an error of about {size:.2g} deg that repeats {order} times "
                f"per turn, but the spec states no such error: add harmonics of order {order} to the angle of this "
                "axis in [rig.table]; or does the drive have backlash? Then approach every stop from the same side"
            )
            yield f"waves of the angle of the axis {axis.name}, order {order}", (wave.test(excess), sentence)
