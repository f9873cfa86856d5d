"""The residual after calibration: errors on a requirement's grid, linear in the parameters, and named statistics.

    s(T, ω)² = ψ(T, ω)ᵀ C ψ(T, ω)

for a scale factor (dimensionless) and, without ω, for a bias (rad/s) or any other term. With a model discrepancy `γ`
(prior Γ) of functions χ that the calibration does not carry, the error at a point is `ψᵀ(β − β̂) + χᵀγ`; since the
estimation error is uncorrelated with every function of the data, its variance is `ψᵀC_ββψ + 2ψᵀC_βγχ + χᵀΓχ`.

A `Residual` is a function of a root of the covariance for searches and derivatives; a `ResidualMap` its values.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Inexact, Int

from gradcal_jax.arrays import AnyArray, fixed, namespace
from gradcal_jax.information.posterior import Posterior
from gradcal_jax.model import AXIS_NAMES, SCALE_FACTOR, Channel, ChannelKind, GradientOfBias, ImuModel, OwnTerm
from gradcal_jax.model.build import MISALIGNMENT, BuiltImu
from gradcal_jax.model.nodes import INPUTS
from gradcal_jax.spec.requirement import (
    QUANTITIES,
    AccelerometerBiasRequirement,
    GyroBiasRequirement,
    GyroScaleFactorRequirement,
    MisalignmentRequirement,
    Requirement,
    Statistic,
)
from gradcal_jax.units import DEG_PER_H, PPM, G

STATISTICS: tuple[Statistic, ...] = get_args(Statistic)
EXACT = np.asarray(np.inf)
"""Value of `sharpness` for which a smooth statistic equals the statistic."""
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
# Grids of requirements that are kept with a model.
_MOST_GRIDS = 32
# Imaginary step of a derivative, which is exact to rounding.
_STEP = 1e-30
_MISALIGNMENTS = tuple(MISALIGNMENT.format(axis) for axis in AXIS_NAMES)


class GridElement(NamedTuple):
    """Errors of the `g` points of a grid as linear functions `rows` of the parameters `where`; of several states `s` of
    the service the worst counts at every point. `alone`: the discrepancy's part of them, which the calibration does not
    carry (None: nothing), and `beyond` its prior variance there, which takes the place of its part of `cᵀCc`."""

    label: str
    where: Int[np.ndarray, " k"]
    rows: Float[np.ndarray, "s g k"]
    alone: Float[np.ndarray, "g k"] | None
    beyond: Float[np.ndarray, " g"]

    def variance(self, root: Float[AnyArray, "p r"]) -> Float[AnyArray, " g"]:
        """The variance on the points, by a root of the covariance of all parameters."""
        own, xp = root[self.where], namespace(root)
        left = xp.max(_squares(self.rows @ own), axis=0) + self.beyond
        return left if self.alone is None else left - _squares(self.alone @ own)

    def deviations(self, known: Posterior) -> Float[np.ndarray, " g"]:
        """Standard deviation on the points after a calibration; `inf` where it is unobservable."""
        deviations = np.sqrt(self.variance(known.spread))
        if known.hidden.shape[1]:
            own = Posterior(known.spread[self.where], known.hidden[self.where])
            unseen = np.isinf([own.deviations(rows) for rows in self.rows])
            deviations = np.where(np.any(unseen, axis=0), np.inf, deviations)
        return deviations

    def part(self, covariance: Float[np.ndarray, "p p"], root: Float[np.ndarray, "p r"]) -> Float[np.ndarray, " g"]:
        """What a part of the covariance adds to the variance, in the states that are the worst ones by `root`."""
        worst = np.argmax(_squares(self.rows @ root[self.where]), axis=0)
        rows, part = self.rows[worst, np.arange(len(worst))], covariance[np.ix_(self.where, self.where)]
        whole = np.sum((rows @ part) * rows, axis=1)
        return whole if self.alone is None else whole - np.sum((self.alone @ part) * self.alone, axis=1)


def _squares(half: Float[AnyArray, "*g r"]) -> Float[AnyArray, "*g"]:
    return namespace(half).einsum("...r,...r->...", half, half)


def grid_element(
    model: ImuModel, label: str, rows: Float[np.ndarray, "g p"], states: Float[np.ndarray, "s 1 p"] | None = None
) -> GridElement:
    """An element from functions of all parameters; `states`: what each state of the service adds to them."""
    seen = np.any(rows, axis=0) if states is None else np.any(rows, axis=0) | np.any(states, axis=(0, 1))
    where = np.flatnonzero(seen)
    own, stds = rows[:, where], model.discrepancy_stds[where]
    every = own[None] if states is None else own + states[:, :, where]
    alone = own * (stds > 0.0) if np.any(stds) else None
    return GridElement(label, where, every, alone, own**2 @ stds**2)


def map_rows(
    model: ImuModel,
    channel: Channel,
    name: str,
    temperature: Float[np.ndarray, " g"],
    rate: Float[np.ndarray, " g"] | None = None,
) -> Float[np.ndarray, "g p"]:
    """The error of a channel's map at points (°C, rad/s; without rates at rest), with its discrepancy, as a function of
    all parameters; zero for a term that the channel does not have."""
    rows, of = np.zeros((len(temperature), model.size)), channel.map(name)
    at = temperature, np.zeros(len(temperature)) if rate is None else rate
    for part in () if of is None else (of, of.beyond):
        if part is not None:
            rows[:, model.where(channel.kind, channel.axis, part.name)] = part.values(*at)
    return rows


class ResidualMap(NamedTuple):
    """Standard deviations of a requirement's quantity in `unit`: `values` `(m, n_T, n_ω)` of the `m` elements `labels`,
    on its temperatures (°C) and, for the scale factor, rates (rad/s)."""

    requirement: Requirement
    labels: tuple[str, ...]
    temperatures: np.ndarray
    rates: np.ndarray
    values: np.ndarray
    unit: str

    def statistic(self, name: Statistic | None = None) -> float:
        """The requirement's statistic, or the one of that `name`; infinite: not observable. Each element has one over
        temperature (and rate); over several elements it is the worst or, for "all", the root mean square."""
        each = self._each(name or self.requirement.statistic)
        return float(np.sqrt(np.mean(each**2)) if self.requirement.axis == "all" else np.max(each))

    def worst_axis(self) -> str | None:
        """The element with the largest statistic; None where all count together, or for a single one."""
        if self.requirement.axis == "all" or len(self.labels) < 2:
            return None
        return self.labels[int(np.argmax(self._each(self.requirement.statistic)))]

    def _each(self, name: Statistic) -> np.ndarray:
        return np.array([statistic(name, values) for values in self.values])


class Residual(NamedTuple):
    """A requirement's residual as a function of the covariance, in SI: of its `elements` on its grid, with the variance
    `added` of an independent error that no plan changes. `unseen` `(p, k)`: further columns of a root."""

    requirement: Requirement
    temperatures: np.ndarray
    rates: np.ndarray
    elements: tuple[GridElement, ...]
    added: float
    unseen: tuple[Float[AnyArray, "p k"], ...] = ()

    def __call__(
        self, root: Float[AnyArray, "p r"], sharpness: Float[AnyArray, ""] | float = EXACT
    ) -> Float[AnyArray, ""] | float:
        """The statistic by a root of the covariance of all parameters: exact for an infinite sharpness, from above
        otherwise."""
        root = namespace(root, self.unseen).concatenate([root, *self.unseen], axis=1)
        return self.of(self.variances(root), sharpness)

    def variances(self, root: Float[AnyArray, "p r"]) -> list[Float[AnyArray, " g"]]:
        """The variances on each element's points."""
        return [element.variance(root) + self.added for element in self.elements]

    def of(self, variances: list[AnyArray], sharpness: Float[AnyArray, ""] | float = EXACT) -> Any:
        """The statistic by the variances on each element's points."""
        xp, shape, kind = namespace(*variances), (len(self.temperatures), -1), self.requirement.statistic
        every = xp.stack([statistic(kind, xp.reshape(xp.sqrt(of), shape), sharpness) for of in variances])
        together = self.requirement.axis == "all"
        return xp.sqrt(xp.mean(every**2)) if together else largest(every[:, None], sharpness)[0]

    def slope(self, variances: list[np.ndarray], changes: list[np.ndarray]) -> float:
        """The derivative of the statistic's logarithm along changes of the variances (Squire and Trapp, 1998)."""
        moved = [of + 1j * _STEP * by for of, by in zip(variances, changes, strict=True)]
        value = self.of(moved)
        return float(value.imag / value.real) / _STEP

    def map(self, known: Posterior) -> ResidualMap:
        """Its values for a posterior."""
        *_, unit, factor = QUANTITIES[self.requirement.quantity]
        shape = len(self.elements), len(self.temperatures), len(self.rates)
        deviations = np.reshape([element.deviations(known) for element in self.elements], shape)
        values = factor * (np.hypot(deviations, self.added**0.5) if self.added else deviations)
        labels = tuple(element.label for element in self.elements)
        return ResidualMap(self.requirement, labels, self.temperatures, self.rates, values, unit)


def statistic(
    name: Statistic, values: Inexact[AnyArray, "n_T n_w"], sharpness: Float[AnyArray, ""] | float = EXACT
) -> Inexact[AnyArray, ""] | float | complex:
    """A named statistic of a residual map: exact for an infinite sharpness, from above otherwise.

    "mean of max": mean over rate of the maximum over temperature (the paper's figure); the others are of all points.
    """
    xp = namespace(values)
    if name == "mean of max":
        return xp.mean(largest(values, sharpness))
    if name == "max":
        return largest(xp.reshape(values, (-1, 1)), sharpness)[0]
    if name == "mean":
        return xp.mean(values)
    return xp.sqrt(xp.mean(values**2))


def largest(values: Inexact[AnyArray, "n m"], sharpness: Float[AnyArray, ""] | float) -> Inexact[AnyArray, " m"]:
    """Maximum along the first axis, exact for an infinite sharpness k, otherwise `(Σ values^k)^(1/k)`, from above."""
    xp = namespace(values, sharpness)
    peak = xp.max(values, axis=0)
    if isinstance(sharpness, float | np.ndarray) and np.isinf(sharpness):
        return peak
    soft = xp.isfinite(sharpness)
    k = xp.where(soft, sharpness, 1.0)
    scale = fixed(peak)
    norm = scale * xp.sum((values / scale[None]) ** k, axis=0) ** (1.0 / k)
    return xp.where(soft, norm, peak)


def residual_of(built: BuiltImu, requirement: Requirement, unseen: Sequence[AnyArray] = ()) -> Residual:
    """A requirement's residual. What no plan changes: the mounting's uncertainty of a misalignment relative to the
    case, or a sensitivity to dT/dt that is a figure and no parameter of a bias on a slope."""
    beside, sensor = 0.0, built.spec.sensor
    if isinstance(requirement, MisalignmentRequirement):
        if requirement.relative_to == "case" and sensor.frame != "case":
            beside = float(built.spec.rig.table.mounting[0].accuracy)
    elif isinstance(requirement, GyroBiasRequirement | AccelerometerBiasRequirement):
        triad = getattr(sensor, QUANTITIES[requirement.quantity].kind)
        if triad.gradient_sensitivity is None:
            beside = triad.gradient_std * max(abs(slope) for _, slope in requirement.service())
    # (A sweep has one model, and computes the grids of its requirements once; those of swept requirements go again.)
    known: dict[Any, Residual] = {} if built.about is not None else vars(built.model).setdefault("_grids", {})
    if requirement not in known:
        if len(known) >= _MOST_GRIDS:
            known.clear()
        temperatures, rates = _grid(requirement)
        elements = tuple(_elements(built, requirement, temperatures, rates))
        known[requirement] = Residual(requirement, temperatures, rates, elements, 0.0)
    return known[requirement]._replace(added=beside**2, unseen=tuple(unseen))


def residual_map(built: BuiltImu, known: Posterior, requirement: Requirement) -> ResidualMap:
    """The residual of a requirement for a posterior."""
    return residual_of(built, requirement).map(known)


def _grid(requirement: Requirement) -> tuple[np.ndarray, np.ndarray]:
    """A requirement's temperatures (°C) and rates (rad/s)."""
    cold, warm = map(float, requirement.temperature)
    temperatures = np.linspace(cold, warm, requirement.grid[0])
    if not isinstance(requirement, GyroScaleFactorRequirement):
        return temperatures, np.zeros(1)
    slow, fast = map(float, requirement.rate)
    return temperatures, np.linspace(slow, fast, requirement.grid[1])


def _elements(
    built: BuiltImu, requirement: Requirement, temperatures: np.ndarray, rates: np.ndarray
) -> Iterator[GridElement]:
    """Each element of a quantity, temperatures first."""
    model, about, wanted = built.model, built.about, requirement.axis
    kind, _, term, *_ = QUANTITIES[requirement.quantity]
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        for label, rows in _internal_misalignments(model, kind, temperatures, about):
            if wanted in ("all", "worst") or wanted in label.split()[0]:
                yield grid_element(model, label, rows)
        return
    names = tuple(dict.fromkeys(term.format(axis) for axis in AXIS_NAMES))
    by_matrix = about is not None and term in (SCALE_FACTOR, MISALIGNMENT)
    matrix = _matrix_errors(model, kind, temperatures, about) if by_matrix else np.zeros(0)
    grid = [of.ravel() for of in np.meshgrid(temperatures, rates, indexing="ij")]
    for c in model.channels:
        axis = AXIS_NAMES[c.axis]
        if c.kind != kind or wanted not in ("all", "worst", axis):
            continue
        for k, name in enumerate(names):
            if term == MISALIGNMENT and k == c.axis:
                continue
            rows = map_rows(model, c, name, *grid)
            if by_matrix and _corrected_by_matrix(c, name):
                across = c.axis if name == SCALE_FACTOR else k
                left = matrix[c.axis, across] - _at_rest(model, c, name, temperatures)
                rows = rows + np.repeat(left, len(rates), axis=0)
            label = axis + AXIS_NAMES[k] if len(names) > 1 else axis
            yield grid_element(model, label, rows, _states(model, c, requirement))


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
    scaled = QUANTITIES[requirement.quantity].term == SCALE_FACTOR
    own = (f"{INPUTS[channel.kind]} {AXIS_NAMES[channel.axis]}",) if scaled else ()
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


def _matrix_errors(
    model: ImuModel, kind: ChannelKind, temperatures: np.ndarray, about: np.ndarray | None
) -> Float[np.ndarray, "3 3 n_T p"]:
    """What a correction by a triad's whole matrix, A = (1 + M)(1 + m) `about` the parameters of an estimate, leaves
    along i of an input along j at rate zero: A⁻¹ δA. Without an estimate of an ideal triad.

    A plan may tell it better than M or m: products of both, or, without an encoder, what a common rotation of all
    sensors changes in each M.
    """
    by_scale, by_others = (np.zeros((3, size, len(temperatures), model.size)) for size in (1, 3))
    for c in (of for of in model.channels if of.kind == kind):
        for rows, names in ((by_scale, (SCALE_FACTOR,)), (by_others, _MISALIGNMENTS)):
            rows[c.axis] = [_at_rest(model, c, name, temperatures) for name in names]
    values = np.zeros(model.size) if about is None else about
    scale, across = 1.0 + by_scale @ values, np.eye(3)[..., None] + by_others @ values
    inverse = np.linalg.inv(np.moveaxis(scale * across, -1, 0))
    change = across[..., None] * by_scale + scale[..., None] * by_others
    return np.einsum("tik,kjtp->ijtp", inverse, change)


def _internal_misalignments(
    model: ImuModel, kind: ChannelKind, temperatures: np.ndarray, about: np.ndarray | None
) -> Iterator[tuple[str, np.ndarray]]:
    """Misalignments that no rotation of the unit changes, by name, `(n_T, p)`: sums of opposite misalignments and, for
    accelerometers, the rotation of their triad against the gyros'. `about`: see `_matrix_errors`."""
    own, gyro = (_matrix_errors(model, of, temperatures, about) for of in (kind, "gyro"))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        name = AXIS_NAMES[i] + AXIS_NAMES[j]
        yield name, own[i, j] + own[j, i]
        if kind == "accelerometer":
            yield f"{name} to the gyros", 0.5 * (own[i, j] - own[j, i] - gyro[i, j] + gyro[j, i])
