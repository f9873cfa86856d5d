"""Residuals of an IMU's quantities after a plan: linear functions of its parameters, and statistics."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from gradcal_jax.information import Posterior, contrasts, statistic
from gradcal_jax.information.missions import Flight, mission_contrasts, mission_rows
from gradcal_jax.information.residual import Contrasts, GridElement, Residual, Statistic
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.model import (
    AXIS_NAMES,
    BIAS,
    SCALE_FACTOR,
    Channel,
    ChannelKind,
    GradientOfBias,
    ImuModel,
    OwnTerm,
)
from gradcal_jax.model.build import (
    G_SENSITIVITY,
    MISALIGNMENT,
    SECOND_ORDER,
    BuiltImu,
)
from gradcal_jax.model.nodes import INPUTS
from gradcal_jax.spec.requirement import (
    AccelerometerBiasRequirement,
    GyroBiasRequirement,
    GyroScaleFactorRequirement,
    MisalignmentRequirement,
    MissionHeadingRequirement,
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


class ImuResidual(NamedTuple):
    """Standard deviations of a requirement's quantity in `unit`: `values` `(m, n_T, n_ω)` of the `m` elements `labels`,
    on its temperatures (°C; for missions their numbers) and, for the scale factor, rates (rad/s). `si`: how many of the
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
        value = together(self.requirement, self._each(name or self.requirement.statistic))
        return float(value) if np.isfinite(value) else None

    def finite_statistic(self, name: Statistic | None = None) -> float:
        """The same, infinite where it is not observable."""
        value = self.statistic(name)
        return np.inf if value is None else value

    def worst_axis(self) -> str | None:
        """The element with the largest statistic; None where all count together, or for a single one."""
        if self.requirement.axis == "all" or len(self.labels) < 2:
            return None
        return self.labels[int(np.argmax(self._each(self.requirement.statistic)))]

    def _each(self, name: Statistic) -> np.ndarray:
        return np.array([statistic(name, values) for values in self.values])


def together(requirement: Requirement, each: np.ndarray) -> np.ndarray:
    """The statistics `(m, …)` of the elements of a requirement as one: the worst, or the root mean square."""
    return np.asarray(np.sqrt(np.mean(each**2, axis=0)) if requirement.axis == "all" else np.max(each, axis=0))


class RequiredQuantity(NamedTuple):
    """A requirement's quantity on its grid, independent of the plan, for computing a `ImuResidual`. `beside`: an
    independent error that no plan changes."""

    requirement: Requirement
    temperatures: np.ndarray
    rates: np.ndarray
    elements: tuple[GridElement, ...]
    beside: float

    def statistic(self, name: Statistic, unseen: Mapping[str, np.ndarray]) -> Residual:
        """A statistic as a function of the covariance, with the columns `(p, k)` of `unseen` errors added."""
        added = tuple(
            np.full(len(e.of.beyond), self.beside**2)
            + sum(np.sum((e.of.rows @ columns[e.where]) ** 2, axis=1) for columns in unseen.values())
            for e in self.elements
        )
        shape, requirement = (len(self.temperatures), len(self.rates)), self.requirement
        return Residual(self.elements, added, shape, name, requirement.axis == "all")

    def residual(self, known: Posterior, *, whole: bool = False) -> ImuResidual:
        """The residual of the quantity for a posterior; `whole` as of `GridElement.deviations`."""
        shape = len(self.elements), len(self.temperatures), len(self.rates)
        deviations = np.stack([element.deviations(known, whole=whole) for element in self.elements]).reshape(shape)
        if self.beside:
            deviations = np.hypot(deviations, self.beside)
        unit, factor = UNIT_OF[self.requirement.quantity]
        labels = tuple(element.label for element in self.elements)
        return ImuResidual(self.requirement, labels, self.temperatures, self.rates, deviations * factor, unit, factor)


def box(requirement: Requirement) -> tuple[np.ndarray, np.ndarray]:
    """A requirement's temperatures (°C) and rates (rad/s) on its grid; for missions their indices."""
    if isinstance(requirement, MissionHeadingRequirement):
        return np.arange(float(len(requirement.mission))), np.zeros(1)
    cold, warm = requirement.temperature
    temperatures = np.linspace(float(cold), float(warm), requirement.grid[0])
    if not isinstance(requirement, GyroScaleFactorRequirement):
        return temperatures, np.zeros(1)
    slow, fast = requirement.rate
    return temperatures, np.linspace(float(slow), float(fast), requirement.grid[1])


def quantity_of(built: BuiltImu, requirement: Requirement) -> RequiredQuantity:
    """A requirement's quantity on its grid. `beside`: the mounting's uncertainty,
    added to a misalignment relative to the case, or that of a sensitivity to dT/dt, added to a bias on a slope."""
    (temperatures, rates), beside = box(requirement), 0.0
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "case":
        frame = built.spec.sensor.frame
        if frame != "case":
            beside = float(built.spec.rig.table.mounting[0].accuracy)
    elif isinstance(requirement, GyroBiasRequirement | AccelerometerBiasRequirement):
        # A sensitivity to dT/dt that is a figure and no parameter.
        triad = getattr(built.spec.sensor, "gyro" if isinstance(requirement, GyroBiasRequirement) else "accelerometer")
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
    model = built.model
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        own: ChannelKind = "gyro" if requirement.quantity == "gyro_misalignment" else "accelerometer"
        for label, rows in internal_misalignments(model, own, temperatures, built.about):
            if requirement.axis in ("all", "worst") or requirement.axis in label.split()[0]:
                yield GridElement(label, slice(None), _plain(rows))
    elif isinstance(requirement, MissionHeadingRequirement):
        for c in model.channels:
            axis = AXIS_NAMES[c.axis]
            if c.kind == "gyro" and requirement.axis in ("all", "worst", axis):
                yield GridElement(axis, model.where(c.kind, c.axis), heading_contrasts(c, requirement))
    else:
        kind, terms = _TERMS[requirement.quantity]
        for c in model.channels:
            axis = AXIS_NAMES[c.axis]
            if c.kind == kind and requirement.axis in ("all", "worst", axis):
                for term, label in terms(axis):
                    element = _of_term(model, c, term, label, temperatures, rates, built.about)
                    path = _states(c, requirement, np.repeat(temperatures, len(rates)))
                    if path is not None and element.where == slice(None):
                        path = np.pad(path, ((0, 0), (0, 0), _around(model, c)))
                    yield element._replace(path=path)


def _states(channel: Channel, requirement: Requirement, temperatures: np.ndarray) -> np.ndarray | None:
    """The states of the service at every point of the grid `(s, g, channel's p)`: after a leg of more than twice its
    width a play is behind the temperature by its width, between that and its opposite elsewhere, where the error is
    smaller than at one of both ends. None without a path."""
    service = getattr(requirement, "service", None)
    states = ((0.0, 0.0),) if service is None else service()
    if states == ((0.0, 0.0),):
        return None
    own = (f"{INPUTS[channel.kind]} {AXIS_NAMES[channel.axis]}",) if "scale_factor" in requirement.quantity else ()
    rows = np.zeros((len(states), len(temperatures), channel.size))
    for term in channel.terms:
        place = channel.where(term.name).start
        if isinstance(term, OwnTerm) and term.signals == own:
            rows[:, :, place] = np.array([term.in_service(*state) for state in states])[:, None]
        elif isinstance(term, GradientOfBias) and not own:
            rows[:, :, place] = np.array([slope for _, slope in states])[:, None]
    return rows


_TERMS = {
    "gyro_bias": ("gyro", lambda a: [("bias", a)]),
    "gyro_scale_factor": ("gyro", lambda a: [(SCALE_FACTOR, a)]),
    "gyro_misalignment": ("gyro", lambda a: [(MISALIGNMENT.format(b), a + b) for b in AXIS_NAMES if b != a]),
    "g_sensitivity": ("gyro", lambda a: [(G_SENSITIVITY.format(b), a + b) for b in AXIS_NAMES]),
    "accelerometer_bias": ("accelerometer", lambda a: [(BIAS, a)]),
    "accelerometer_scale_factor": ("accelerometer", lambda a: [(SCALE_FACTOR, a)]),
    "accelerometer_misalignment": (
        "accelerometer",
        lambda a: [(MISALIGNMENT.format(b), a + b) for b in AXIS_NAMES if b != a],
    ),
    "second_order": ("accelerometer", lambda a: [(SECOND_ORDER, a)]),
}


def _of_term(
    model: ImuModel,
    channel: Channel,
    term: str,
    label: str,
    temperatures: np.ndarray,
    rates: np.ndarray,
    about: np.ndarray | None,
) -> GridElement:
    """The linear function of one term of a channel on the grid."""
    of, own = channel.map(term), model.where(channel.kind, channel.axis)
    if of is not None and of.of_own_input and not any(map(channel.term, _MISALIGNMENTS)):
        about = None
    grid = np.meshgrid(temperatures, rates, indexing="ij")
    own_part = contrasts(channel, term, *(of.ravel() for of in grid))
    if about is None:
        return GridElement(label, own, own_part)
    around = (0, 0), _around(model, channel)
    left = _row(model, channel.kind, channel.axis, term, temperatures, about)
    left[:, own] -= _signal_rows(channel, term, temperatures)
    rows = np.pad(np.asarray(own_part.rows), around) + np.repeat(left, len(rates), axis=0)
    alone = np.pad(np.asarray(own_part.alone), around)
    return GridElement(label, slice(None), Contrasts(rows, alone, own_part.beyond))


def _around(model: ImuModel, channel: Channel) -> tuple[int, int]:
    """The number of the model's parameters before those of a channel, and after them."""
    own = model.where(channel.kind, channel.axis)
    return own.start, model.size - own.stop


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
            own = about[model.where(kind, k)]
            scale[:, k] += _signal_rows(of, SCALE_FACTOR, temperatures) @ own
            for other, term in enumerate(_MISALIGNMENTS):
                across[:, k, other] += _signal_rows(of, term, temperatures) @ own
    inverse = np.linalg.inv(scale[:, :, None] * across)[:, i]
    rows = np.zeros((len(temperatures), model.size))
    for k, of in enumerate(triad):
        if of is not None:
            by_scale = across[:, k, j, None] * _signal_rows(of, SCALE_FACTOR, temperatures)
            changed = by_scale + scale[:, k, None] * _signal_rows(of, _MISALIGNMENTS[j], temperatures)
            rows[:, model.where(kind, k)] = inverse[:, k, None] * changed
    return rows


def _plain(rows: np.ndarray) -> Contrasts:
    """Contrasts without a part of a model's discrepancy."""
    return Contrasts(rows, np.zeros_like(rows), np.zeros(len(rows)))


def heading_contrasts(channel: Channel, requirement: MissionHeadingRequirement) -> Contrasts:
    """The error of a gyro's heading at the end of every mission, rad."""
    rows = []
    for mission in requirement.mission:
        time, rate, temperature, _ = (np.array(column) for column in mission.rows)
        rows.append(mission_rows(channel, Flight(time, rate, temperature), time[-1:])[0])
    return mission_contrasts(channel, np.stack(rows))


def _signal_rows(channel: Channel, term: str, temperatures: np.ndarray) -> np.ndarray:
    """Contrasts `(n_T, channel's p)` of a term at rate zero, without its discrepancy."""
    of, rows = channel.map(term), np.zeros((len(temperatures), channel.size))
    if of is not None:
        rows[:, channel.where(term)] = of.values(temperatures, np.zeros(len(temperatures)))
    return rows


def _row(
    model: ImuModel,
    kind: ChannelKind,
    axis: int,
    term: str,
    temperatures: np.ndarray,
    about: np.ndarray | None = None,
) -> np.ndarray:
    """Contrasts `(n_T, p)` of a term at rate zero; zero where the model does not have it.

    A misalignment or scale factor `about` the parameters of an estimate is what a correction leaves of it
    (`_left_by_correction`).
    """
    rows = np.zeros((len(temperatures), model.size))
    if (channel := model.channel(kind, axis)) is None:
        return rows
    if about is not None and term in (SCALE_FACTOR, *_MISALIGNMENTS):
        across = axis if term == SCALE_FACTOR else _MISALIGNMENTS.index(term)
        return _left_by_correction(model, (kind, axis, across), temperatures, about)
    rows[:, model.where(kind, axis)] = _signal_rows(channel, term, temperatures)
    return rows


_MISALIGNMENTS = tuple(MISALIGNMENT.format(axis) for axis in AXIS_NAMES)


def internal_misalignments(
    model: ImuModel, kind: ChannelKind, temperatures: np.ndarray, about: np.ndarray | None = None
) -> Iterator[tuple[str, np.ndarray]]:
    """Misalignments that no rotation of the unit changes, by name, `(n_T, p)`: sums of opposite misalignments and, for
    accelerometers, the rotation of their triad against the gyros'. `about` `(p,)`: see `_row`."""

    def of(which: ChannelKind, i: int, j: int) -> np.ndarray:
        return _row(model, which, i, MISALIGNMENT.format(AXIS_NAMES[j]), temperatures, about)

    for i, j in ((0, 1), (0, 2), (1, 2)):
        name = AXIS_NAMES[i] + AXIS_NAMES[j]
        yield name, of(kind, i, j) + of(kind, j, i)
        if kind == "accelerometer":
            apart = of(kind, i, j) - of(kind, j, i) - of("gyro", i, j) + of("gyro", j, i)
            yield f"{name} to the gyros", 0.5 * apart
