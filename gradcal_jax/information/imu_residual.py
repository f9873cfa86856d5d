"""Residuals of an IMU's quantities after a plan: linear functions of its parameters on a requirement's grid."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from gradcal_jax.information import Posterior
from gradcal_jax.information.residual import GridElement, Residual, Statistic, grid_element, map_rows, statistic
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.model import AXIS_NAMES, BIAS, SCALE_FACTOR, Channel, ChannelKind, GradientOfBias, ImuModel, OwnTerm
from gradcal_jax.model.build import G_SENSITIVITY, MISALIGNMENT, SECOND_ORDER, BuiltImu
from gradcal_jax.model.nodes import INPUTS
from gradcal_jax.spec.requirement import (
    AccelerometerBiasRequirement,
    GyroBiasRequirement,
    GyroScaleFactorRequirement,
    MisalignmentRequirement,
    Requirement,
)
from gradcal_jax.units import DEG_PER_H, PPM, G

UNITS_OF_TERMS = {
    "rad/s": ("deg/h", DEG_PER_H),
    "1": ("ppm", PPM),
    "rad/K": ("deg/h/(°C/min)", DEG_PER_H / 60.0),
    "rad/s/K": ("deg/h/K", DEG_PER_H),
    "1/K": ("ppm/K", PPM),
    "s/K": ("ppm/(K/min)", PPM / 60.0),
    "m/s^2/K": ("ug/K", 1e6 / G),
    "m/s/K": ("ug/(K/min)", 1e6 / G / 60.0),
    "rad": ("urad", 1e6),
    "m/s^2": ("ug", 1e6 / G),
    "rad/s/(m/s^2)": ("deg/h/g", DEG_PER_H * G),
    "1/(m/s^2)": ("ug/g^2", 1e6 * G),
}
"""For each SI unit of a coefficient: the reported unit, and the number of these units in one SI unit."""
_MISALIGNMENTS = tuple(MISALIGNMENT.format(axis) for axis in AXIS_NAMES)
# Names of terms by quantity: of the channel itself, or one for each axis (of another, of every one).
_TERMS = {
    "gyro_bias": ("gyro", (BIAS,), ""),
    "gyro_scale_factor": ("gyro", (SCALE_FACTOR,), ""),
    "gyro_misalignment": ("gyro", _MISALIGNMENTS, "others"),
    "g_sensitivity": ("gyro", tuple(G_SENSITIVITY.format(axis) for axis in AXIS_NAMES), "all"),
    "accelerometer_bias": ("accelerometer", (BIAS,), ""),
    "accelerometer_scale_factor": ("accelerometer", (SCALE_FACTOR,), ""),
    "accelerometer_misalignment": ("accelerometer", _MISALIGNMENTS, "others"),
    "second_order": ("accelerometer", (SECOND_ORDER,), ""),
}


class ImuResidual(NamedTuple):
    """Standard deviations of a requirement's quantity in `unit`: `values` `(m, n_T, n_ω)` of the `m` elements `labels`,
    on its temperatures (°C) and, for the scale factor, rates (rad/s). `si`: how many of the
    unit are one in SI."""

    requirement: Requirement
    labels: tuple[str, ...]
    temperatures: np.ndarray
    rates: np.ndarray
    values: np.ndarray
    unit: str
    si: float

    def statistic(self, name: Statistic | None = None) -> float | None:
        """The requirement's statistic, or the one of that `name`; None: not observable. Each element has one over
        temperature (and rate); over several elements it is the worst or, for "all", the root mean square."""
        value = self.finite_statistic(name)
        return value if np.isfinite(value) else None

    def finite_statistic(self, name: Statistic | None = None) -> float:
        """The same, infinite where it is not observable."""
        each = self._each(name or self.requirement.statistic)
        return float(np.sqrt(np.mean(each**2)) if self.requirement.axis == "all" else np.max(each))

    def worst_axis(self) -> str | None:
        """The element with the largest statistic; None where all count together, or for a single one."""
        if self.requirement.axis == "all" or len(self.labels) < 2:
            return None
        return self.labels[int(np.argmax(self._each(self.requirement.statistic)))]

    def _each(self, name: Statistic) -> np.ndarray:
        return np.array([statistic(name, values) for values in self.values])


class RequiredQuantity(NamedTuple):
    """A requirement's quantity on its grid, independent of the plan. `beside`: an independent error that no plan
    changes."""

    requirement: Requirement
    temperatures: np.ndarray
    rates: np.ndarray
    elements: tuple[GridElement, ...]
    beside: float

    def statistic(self, name: Statistic, unseen: Mapping[str, np.ndarray]) -> Residual:
        """A statistic as a function of the covariance, with the columns `(p, k)` of `unseen` errors added."""
        shape = len(self.temperatures), len(self.rates)
        together = self.requirement.axis == "all"
        return Residual(self.elements, self.beside**2, shape, name, together, tuple(unseen.values()))

    def residual(self, known: Posterior) -> ImuResidual:
        """The residual of the quantity for a posterior."""
        shape = len(self.elements), len(self.temperatures), len(self.rates)
        deviations = np.stack([element.deviations(known) for element in self.elements]).reshape(shape)
        if self.beside:
            deviations = np.hypot(deviations, self.beside)
        unit, factor = UNIT_OF[self.requirement.quantity]
        labels = tuple(element.label for element in self.elements)
        return ImuResidual(self.requirement, labels, self.temperatures, self.rates, deviations * factor, unit, factor)


def box(requirement: Requirement) -> tuple[np.ndarray, np.ndarray]:
    """A requirement's temperatures (°C) and rates (rad/s) on its grid."""
    cold, warm = requirement.temperature
    temperatures = np.linspace(float(cold), float(warm), requirement.grid[0])
    if not isinstance(requirement, GyroScaleFactorRequirement):
        return temperatures, np.zeros(1)
    slow, fast = requirement.rate
    return temperatures, np.linspace(float(slow), float(fast), requirement.grid[1])


def quantity_of(built: BuiltImu, requirement: Requirement) -> RequiredQuantity:
    """A requirement's quantity on its grid. `beside`: the mounting's uncertainty, added to a misalignment relative to
    the case, or that of a sensitivity to dT/dt, added to a bias on a slope."""
    (temperatures, rates), beside, sensor = box(requirement), 0.0, built.spec.sensor
    if isinstance(requirement, MisalignmentRequirement):
        if requirement.relative_to == "case" and sensor.frame != "case":
            beside = float(built.spec.rig.table.mounting[0].accuracy)
    elif isinstance(requirement, GyroBiasRequirement | AccelerometerBiasRequirement):
        # A sensitivity to dT/dt that is a figure and no parameter.
        triad = getattr(sensor, "gyro" if isinstance(requirement, GyroBiasRequirement) else "accelerometer")
        if triad.gradient_sensitivity is None:
            beside = triad.gradient_std * max(abs(slope) for _, slope in requirement.service())
    elements = tuple(_elements(built, requirement, temperatures, rates))
    return RequiredQuantity(requirement, temperatures, rates, elements, beside)


def imu_residual(built: BuiltImu, known: Posterior, requirement: Requirement) -> ImuResidual:
    """The residual of a requirement's quantity."""
    return quantity_of(built, requirement).residual(known)


def _elements(
    built: BuiltImu, requirement: Requirement, temperatures: np.ndarray, rates: np.ndarray
) -> Iterator[GridElement]:
    """Each element of a quantity, temperatures first."""
    model, about, wanted = built.model, built.about, requirement.axis
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        own: ChannelKind = "gyro" if requirement.quantity == "gyro_misalignment" else "accelerometer"
        for label, rows in internal_misalignments(model, own, temperatures, about):
            if wanted in ("all", "worst") or wanted in label.split()[0]:
                yield grid_element(model, label, rows)
        return
    kind, names, over = _TERMS[requirement.quantity]
    grid = [of.ravel() for of in np.meshgrid(temperatures, rates, indexing="ij")]
    for c in model.channels:
        axis = AXIS_NAMES[c.axis]
        if c.kind != kind or wanted not in ("all", "worst", axis):
            continue
        for k, name in enumerate(names):
            if over == "others" and k == c.axis:
                continue
            rows = map_rows(model, c, name, *grid)
            if about is not None and name in (SCALE_FACTOR, *_MISALIGNMENTS) and _corrected_by_matrix(c, name):
                across = c.axis if name == SCALE_FACTOR else k
                left = _left_by_correction(model, (c.kind, c.axis, across), temperatures, about)
                left = left - _at_rest(model, c, name, temperatures)
                rows = rows + np.repeat(left, len(rates), axis=0)
            yield grid_element(model, axis + AXIS_NAMES[k] if over else axis, rows, _states(model, c, requirement))


def _corrected_by_matrix(channel: Channel, name: str) -> bool:
    """Whether a triad's whole matrix corrects a term: not that of a channel without misalignments."""
    of = channel.map(name)
    return of is None or not of.of_own_input or any(map(channel.term, _MISALIGNMENTS))


def _states(model: ImuModel, channel: Channel, requirement: Requirement) -> np.ndarray | None:
    """What the states of the service add at every point, `(s, 1, p)`: after a leg of more than twice its width a play
    is behind the temperature by its width, between that and its opposite elsewhere, where the error is smaller than at
    one of both ends. None without a path."""
    service = getattr(requirement, "service", None)
    states = ((0.0, 0.0),) if service is None else service()
    if states == ((0.0, 0.0),):
        return None
    own = (f"{INPUTS[channel.kind]} {AXIS_NAMES[channel.axis]}",) if "scale_factor" in requirement.quantity else ()
    rows = np.zeros((len(states), 1, model.size))
    for term in channel.terms:
        place = model.where(channel.kind, channel.axis, term.name).start
        if isinstance(term, OwnTerm) and term.signals == own:
            rows[:, 0, place] = [term.in_service(*state) for state in states]
        elif isinstance(term, GradientOfBias) and not own:
            rows[:, 0, place] = [slope for _, slope in states]
    return rows


def _at_rest(model: ImuModel, channel: Channel, name: str, temperatures: np.ndarray) -> np.ndarray:
    """The error of a map at rate zero without its discrepancy, `(n_T, p)`."""
    return np.where(model.discrepancy_stds > 0.0, 0.0, map_rows(model, channel, name, temperatures))


def _left_by_correction(
    model: ImuModel, element: tuple[ChannelKind, int, int], temperatures: np.ndarray, about: np.ndarray
) -> np.ndarray:
    """What a correction by a triad's whole matrix, A = (1 + M)(1 + m) `about` the parameters of an estimate, leaves
    along i of an input along j (`element`: the kind, i, j), at rate zero: an element of A⁻¹ δA, `(n_T, p)`.

    A plan may tell it better than M or m: products of both, or, without an encoder, what a common rotation of all
    sensors changes in each M.
    """
    kind, i, j = element
    triad = [model.channel(kind, axis) for axis in range(3)]
    scale, across = np.ones((len(temperatures), 3)), np.tile(np.eye(3), (len(temperatures), 1, 1))
    for k, of in enumerate(triad):
        if of is not None:
            scale[:, k] += _at_rest(model, of, SCALE_FACTOR, temperatures) @ about
            for other, term in enumerate(_MISALIGNMENTS):
                across[:, k, other] += _at_rest(model, of, term, temperatures) @ about
    inverse = np.linalg.inv(scale[:, :, None] * across)[:, i]
    rows = np.zeros((len(temperatures), model.size))
    for k, of in enumerate(triad):
        if of is not None:
            by_scale = across[:, k, j, None] * _at_rest(model, of, SCALE_FACTOR, temperatures)
            changed = by_scale + scale[:, k, None] * _at_rest(model, of, _MISALIGNMENTS[j], temperatures)
            rows += inverse[:, k, None] * changed
    return rows


def internal_misalignments(
    model: ImuModel, kind: ChannelKind, temperatures: np.ndarray, about: np.ndarray | None = None
) -> Iterator[tuple[str, np.ndarray]]:
    """Misalignments that no rotation of the unit changes, by name, `(n_T, p)`: sums of opposite misalignments and, for
    accelerometers, the rotation of their triad against the gyros'. `about` `(p,)`: parameters of an estimate, whose
    correction leaves them (`_left_by_correction`)."""

    def of(which: ChannelKind, i: int, j: int) -> np.ndarray:
        channel = model.channel(which, i)
        if channel is None:
            return np.zeros((len(temperatures), model.size))
        if about is not None:
            return _left_by_correction(model, (which, i, j), temperatures, about)
        return _at_rest(model, channel, _MISALIGNMENTS[j], temperatures)

    for i, j in ((0, 1), (0, 2), (1, 2)):
        name = AXIS_NAMES[i] + AXIS_NAMES[j]
        yield name, of(kind, i, j) + of(kind, j, i)
        if kind == "accelerometer":
            apart = of(kind, i, j) - of(kind, j, i) - of("gyro", i, j) + of("gyro", j, i)
            yield f"{name} to the gyros", 0.5 * apart
