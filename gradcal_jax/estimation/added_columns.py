"""Tests of what a model lacks: columns that are added beside those of a fit.

Orthogonal projections remove all estimated parameters, with their priors, from the whitened columns X of what is tested
and from the data z. Then with `X = U S Vᵀ`, `y = Uᵀz` is `N(0, 1 + σ²m)` component by component, `m = S²` being the
gains, if the coefficients are `N(0, σ²)`; if the model is true, `Σ y²` is χ². If a plan's parameters take up the
columns there is nothing to test: two turns to and fro with backlash are a scale-factor error.
"""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.calibration.correction import temperature_slope
from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.imu_readings import ImuReadings
from gradcal_jax.estimation.imu_solve import ImuEstimate
from gradcal_jax.estimation.solve import Whitened, factored
from gradcal_jax.information import Posterior, encoder_rows, imu_system, rows_of_angles, segments_of
from gradcal_jax.information.imu_residual import imu_residual
from gradcal_jax.information.posterior import OBSERVABLE
from gradcal_jax.information.unseen import Answers
from gradcal_jax.model import (
    BIAS,
    DISCREPANCY,
    SCALE_FACTOR,
    Channel,
    Discrepancy,
    GradientOfBias,
    Term,
    make_map,
)
from gradcal_jax.model.build import BuiltImu, basis
from gradcal_jax.model.terms import sides
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import RequirementRow

# Components whose gain is below this share of the largest gain would only add noise to the test.
_SEEN: Final = 1e-4
# Number of degrees beyond the structure that are tested if the spec states no discrepancy.
_MORE: Final = 2
# Standard deviation of the latitude, rad, above which readings say nothing about it.
_LATITUDE: Final = 0.5
# Waves over a turn that encoders and discs off their centres have.
_ORDERS: Final = (1, 2)
# Standard deviation of an error of the table's angles, rad, above which it is not tested.
_ANGLE: Final = np.radians(0.2)
# Backlash, rad, that good gears may have; and the share of a requirement's error from which on it is reported.
_LITTLE: Final = np.radians(0.01)
_MATTERS: Final = 0.5
# Step of finite differences, rad.
_SMALL_TURN: Final = 1e-5


class AddedTest(NamedTuple):
    """The test of some columns, with its name and the sentence of a failure."""

    name: str
    test: Test
    advice: str


class Components(NamedTuple):
    """`y` `(k,)` with the gains `(k,)` (per squared unit of a coefficient)."""

    y: np.ndarray
    gains: np.ndarray

    def test(self, variance: float = 0.0) -> Test:
        """Against more than coefficients of this `variance` explain."""
        return chi_squared_test(float(np.sum(self.y**2 / (1.0 + variance * self.gains))), len(self.gains))

    def scaled(self, excess: float) -> "Components":
        """The same if the noise is larger by the factor `excess`."""
        return Components(self.y / excess, self.gains)

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
        self.at = segments_of(readings.done.motion, readings.model)
        self.steps, _ = imu_system(readings.done.motion, readings.model, self.nodes)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """`(n, k)`, of the rows used, of columns `(R, k)` of all rows."""
        return self.readings.whitened(self.steps, self.readings.by_steps(rows))

    def of_term(self, number: int, term: Term) -> np.ndarray:
        """The columns `(R, k)` of a term if the channel of this number had it; not whitened."""
        model = self.readings.model
        channel = model.channels[number]
        nodes = self.nodes.channel(channel.kind, channel.axis)
        columns = term.columns(nodes)
        rows, own = np.zeros((len(self.at.row_segment), term.size)), self.at.row_channel == number
        rows[own] = self.at.sums(np.asarray(columns))[self.at.row_segment[own]]
        return rows

    def answers(self, solution: ImuEstimate) -> Answers:
        """By how much the estimate is off for one unit of what it does not know; see `information.unseen`."""
        late, numbers = self.late(solution.parameters), range(len(self.readings.model.channels))
        unit = GradientOfBias(std=np.ones(()), has_prior=False)
        columns = [self.of_term(k, unit) for k in numbers]
        columns += [late * (self.at.row_channel == k)[:, None] for k in numbers]
        along = solution.white.rows.T @ self(np.concatenate(columns, axis=1))
        spread = solution.known.spread
        answers = list((spread @ (spread.T @ along)).T)
        return Answers(answers[: len(numbers)], answers[len(numbers) :])

    def late(self, parameters: np.ndarray) -> np.ndarray:
        """What the readings are more, `(R, 1)`, if the maps have the temperature of a second before."""
        readings = self.readings
        before = readings.temperature_c - temperature_slope(readings.temperature_c, readings.log.time_s)
        return (readings.at(before, parameters) - readings.expected(parameters))[:, None]

    def by_latitude(self, parameters: np.ndarray) -> np.ndarray:
        """The derivatives `(R, 1)` with respect to the site's latitude, 1/rad; not whitened."""
        readings, motion = self.readings, self.readings.done.motion
        moved = eqx.tree_at(lambda m: m.geometry.latitude, motion, motion.geometry.latitude + _SMALL_TURN)
        there = readings._replace(done=readings.done._replace(motion=moved))
        return ((there.expected(parameters) - readings.expected(parameters)) / _SMALL_TURN)[:, None]

    def by_shown_angles(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """As `ImuReadings.of_shown_angles`."""
        of_angles = encoder_rows(self.readings.done.motion, self.readings.model, self.nodes)
        return rows_of_angles(self.at, of_angles, before, after)


# --- structure of the maps --------------------------------------------------------------------------------------------


def hidden_maps(spec: Spec, channel: Channel) -> Iterator[Discrepancy]:
    """The polynomials beyond the maps of a gyro, for which a log is tested: those of the spec, or two degrees more."""
    gyro = spec.sensor.gyro
    assert gyro is not None
    for quantity, section in ((BIAS, gyro.bias), (SCALE_FACTOR, gyro.scale_factor)):
        rate = getattr(section, "rate", None)
        if section is None or not isinstance(section.temperature, TemperaturePolynomial):
            continue
        if quantity == SCALE_FACTOR and not isinstance(rate, RatePolynomial):
            continue
        term = channel.term(DISCREPANCY.format(quantity))
        if not isinstance(term, Discrepancy):
            degrees = section.temperature.degree + _MORE, 0 if rate is None else rate.degree + _MORE
            over_rate = None if rate is None else basis(rate)
            # (The result of a test does not depend on the size.)
            term = make_map(basis(section.temperature), over_rate, name=quantity, discrepancy=(1.0, *degrees)).beyond
        assert term is not None
        yield term


def structure_tests(spec: Spec, whiten: Whitener, solution: ImuEstimate, beside: Beside) -> Iterator[AddedTest]:
    """The test of each polynomial map of each gyro. A discrepancy that the spec states is no contradiction of it, up to
    its size."""
    model = whiten.readings.model
    hidden = [
        (k, channel, term)
        for k, channel in enumerate(model.channels)
        if channel.kind == "gyro"
        for term in hidden_maps(spec, channel)
    ]
    if not hidden:
        return
    # Whitened together: that costs hardly more than one of them.
    every = whiten(np.concatenate([whiten.of_term(k, term) for k, _, term in hidden], axis=1))
    for (_, channel, term), columns in zip(hidden, _split(every, [t.size for *_, t in hidden]), strict=True):
        stated = channel.term(term.name) is not None
        own = Beside(solution.white.without(model.where("gyro", channel.axis, term.name))) if stated else beside
        of = own.components(columns)
        if len(of.gains):
            quantity = term.name.removesuffix("_discrepancy").replace("_", " ")
            test = of.test(float(term.std) ** 2 if stated else 0.0)
            yield AddedTest(
                f"{channel.name}: structure of the {quantity}",
                test,
                f"{channel.name.replace('_', ' ')}: the log shows structure of the {quantity} that the model lacks "
                f"(p-value {test.probability:.1g}): raise the degree of its polynomial in temperature or in rate",
            )


# --- figures of the site and of the table -----------------------------------------------------------------------------


def _split(columns: np.ndarray, sizes: Sequence[int]) -> list[np.ndarray]:
    return np.split(columns, np.cumsum(sizes)[:-1], axis=1)


def latitude_test(spec: Spec, whiten: Whitener, solution: ImuEstimate, beside: Beside) -> Iterator[AddedTest]:
    """Of a wrong latitude the vertical rate resembles a sensitivity to g, and only the horizontal one contradicts it.
    Nothing where the readings hardly tell it from the parameters."""
    if spec.rig.site.is_unknown:
        return
    column = whiten(whiten.by_latitude(solution.parameters))
    of = beside.components(column)
    if not of.tells(_LATITUDE):
        return
    stated, std = np.degrees(spec.rig.site.latitude_rad), np.degrees(of.gains[0] ** -0.5)
    seen = stated + np.degrees(float(column[:, 0] @ solution.estimate.residuals) / of.gains[0])
    yield AddedTest(
        "latitude of the site",
        of.test(),
        f"the gyros observe the Earth's rate at a latitude of about {seen:.0f} ± {max(std, 1.0):.0f} deg, but the spec "
        f"states {stated:.4g} deg: is [rig.site] latitude correct?",
    )


class AngleColumns(NamedTuple):
    """Of errors of an axis's angles: components on `backlash` (None if the axis turns in one direction only) with its
    whitened column `lash` `(n, 1)`, and on the `waves` by order; all beside an unknown scale error, which is no
    parameter: 1 ppm of it is 0.001 deg after three turns."""

    axis: str
    lash: np.ndarray
    backlash: Components | None
    waves: dict[int, Components]


def angle_columns(spec: Spec, whiten: Whitener, beside: Beside) -> list[AngleColumns]:
    """Of every axis of the table, without the waves that the spec has; none where no angle is read at rest."""
    motion = whiten.readings.done.motion
    if motion.line.rates or whiten.readings.free:
        return []
    ends, places, rows = np.stack(motion.angles()), [], []
    for number, axis in enumerate(spec.rig.table.axis):
        angle = ends[..., number]
        side = np.stack(sides(*angle))
        # Zero for an axis that turns in one direction only.
        both_ways = np.ptp(side) == 1.0
        orders = sorted(set(_ORDERS) - {wave.order for wave in axis.angle.harmonics})
        own = [angle, *(wave(order * angle) for order in orders for wave in (np.cos, np.sin))]
        errors = np.zeros((*ends.shape, len(own) + 1))
        errors[..., number, :] = np.stack([*own, side * both_ways], axis=-1)
        places.append((axis.name, orders, bool(both_ways)))
        rows.append(whiten.by_shown_angles(errors[0], errors[1]))
    found = list[AngleColumns]()
    every = _split(whiten(np.concatenate(rows, axis=1)), [of.shape[1] for of in rows])
    for (name, orders, both_ways), columns in zip(places, every, strict=True):
        scale, lash = columns[:, :1], columns[:, -1:]
        waves = {order: beside.components(columns[:, 1 + 2 * k : 3 + 2 * k], scale) for k, order in enumerate(orders)}
        found.append(AngleColumns(name, lash, beside.components(lash, scale) if both_ways else None, waves))
    return found


def angle_tests(angles: list[AngleColumns], excess: float) -> Iterator[AddedTest]:
    """Backlash and waves; `excess`: the factor by which the residuals exceed the spec's noise, which is neither."""
    for axis, _, lash, waves in angles:
        if lash is not None and lash.tells(_ANGLE):
            std = lash.gains[0] ** -0.5
            yield AddedTest(
                f"backlash of the axis {axis}",
                lash.scaled(excess).test(),
                f"axis {axis}: the table's angles after turns in one direction differ by "
                f"{np.degrees(abs(lash.y[0]) * std):.2g} ± {np.degrees(excess * std):.1g} deg from those after turns "
                "in the other direction: does the drive have backlash? Read the angle at the axis itself, or approach "
                "every stop from the same side",
            )
        for order, wave in waves.items():
            if wave.tells(_ANGLE):
                size = np.degrees(np.linalg.norm(wave.y / np.sqrt(wave.gains)))
                yield AddedTest(
                    f"waves of the angle of the axis {axis}, order {order}",
                    wave.scaled(excess).test(),
                    f"axis {axis}: the table's angle has an error of about {size:.2g} deg that repeats {order} times "
                    f"per turn, but the spec states no such error: add harmonics of order {order} to the angle of this "
                    "axis in [rig.table]",
                )


def backlash_sentences(
    built: BuiltImu, solution: ImuEstimate, angles: list[AngleColumns], rows: tuple[RequirementRow, ...]
) -> Iterator[str]:
    """A sentence for each axis whose backlash the parameters take up, where a little of it would matter and the spec
    does not state it; `rows`: of the spec's requirements, judged."""
    known, typical = solution.known.spread, with_typical(built.spec).rig.table.axis
    for axis, likely, of_axis in zip(built.spec.rig.table.axis, typical, angles, strict=False):
        lash = of_axis.backlash
        if axis.angle.backlash is not None or lash is None or lash.tells(_LITTLE / 2.0):
            continue
        along = solution.white.rows.T @ of_axis.lash
        shift = Posterior(_LITTLE * known @ (known.T @ along), np.zeros((len(known), 0)))
        changes = [imu_residual(built, shift, requirement).statistic() for requirement in built.spec.requirement]
        shares = [c / r.decisive if c and r.decisive else 0.0 for c, r in zip(changes, rows, strict=True)]
        worst = int(np.argmax(shares)) if shares else 0
        if not shares or shares[worst] <= _MATTERS:
            continue
        counted = "the uncertainty does not include it"
        if likely.angle.backlash:
            counted = f"the uncertainty includes {likely.angle.backlash} (1σ), typical of the class"
        elif axis.angle.scale_error is None and likely.angle.scale_error:
            counted = f"the uncertainty includes the scale error of gears with backlash, {likely.angle.scale_error}"
        yield (
            f"the log cannot show backlash of the axis {of_axis.axis}: {np.degrees(_LITTLE):.2g} deg of it would "
            f"change '{rows[worst].name}' by {changes[worst]:.2g} {rows[worst].unit}, and {counted}. State the "
            "backlash of the drive (angle.backlash), read the angle at the axis itself, or approach every stop from "
            "the same side"
        )
