"""What is left of each of a unit's quantities after a plan: linear functions of its parameters, and their statistics."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.api.unit_build import G_SENSITIVITY, MISALIGNMENT, SECOND_ORDER, SPECIFIC_FORCE_BIAS, AssembledUnit
from gradcal_jax.files.unit_requirement import (
    GyroScaleFactorRequirement,
    MisalignmentRequirement,
    PositionRequirement,
    TiltRequirement,
    TurnRequirement,
    UnitRequirement,
)
from gradcal_jax.information import STATISTICS, Posterior, contrasts, statistic
from gradcal_jax.model import AXIS_NAMES, SCALE_FACTOR, ChannelKind, Map, UnitModel
from gradcal_jax.trajectory import EARTH_RATE
from gradcal_jax.units import DEG_PER_H, PPM

_G = 9.80665
UNIT_OF_QUANTITY = {
    "gyro_bias": ("deg/h", DEG_PER_H),
    "gyro_scale_factor": ("ppm", PPM),
    "gyro_misalignment": ("urad", 1e6),
    "g_sensitivity": ("deg/h/g", DEG_PER_H * _G),
    "accelerometer_bias": ("ug", 1e6 / _G),
    "accelerometer_scale_factor": ("ppm", PPM),
    "accelerometer_misalignment": ("urad", 1e6),
    "second_order": ("ug/g^2", 1e6 * _G),
    "position": ("m", 1.0),
    "tilt": ("urad", 1e6),
    "heading": ("deg", np.degrees(1.0)),
}
"""Of each quantity the unit that people read, and that many of it are one in SI."""


class Residual(NamedTuple):
    """Standard deviations of one quantity in people's `unit`: of each of the `m` elements `labels`, on the temperatures
    (°C) and, of the scale factor, the rates (rad/s) of a requirement: `values` `(m, n_T, n_ω)`.
    """

    labels: tuple[str, ...]
    temperatures: np.ndarray
    rates: np.ndarray
    values: np.ndarray
    unit: str


def unit_residual(built: AssembledUnit, known: Posterior, requirement: UnitRequirement) -> Residual:
    """What is left of a requirement's quantity."""
    cold, warm = (float(t) for t in requirement.temperature)
    temperatures = np.linspace(cold, warm, requirement.grid[0])
    rates = np.zeros(1)
    if isinstance(requirement, GyroScaleFactorRequirement):
        rates = np.linspace(float(requirement.rate[0]), float(requirement.rate[1]), requirement.grid[1])
    unit, factor = UNIT_OF_QUANTITY[requirement.quantity]
    labels, values = [], []
    for label, rows, beyond in _elements(built, requirement, temperatures, rates):
        variance = known.deviations(rows[0]) ** 2
        if beyond is not None:
            variance = variance - known.deviations(rows[1]) ** 2 + beyond
        labels.append(label)
        values.append(np.sqrt(variance).reshape(len(temperatures), len(rates)))
    found = np.stack(values)
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "case":
        frame = built.spec.sensor.frame
        if frame is None or frame.fixed_by != "case":
            found = np.hypot(found, float(built.spec.rig.table.mounting[0].accuracy))
    return Residual(tuple(labels), temperatures, rates, found * factor, unit)


def summed_up(requirement: UnitRequirement, found: Residual) -> dict[str, float | None]:
    """The statistics by name; None where the plan cannot tell. Each element has its own over temperature (and rate);
    of several the worst counts, or of "all" the root mean square.
    """
    names = [
        name for name in STATISTICS if name != "mean of max" or isinstance(requirement, GyroScaleFactorRequirement)
    ]
    result: dict[str, float | None] = {}
    for name in names:
        each = np.array([statistic(name, values) for values in found.values])
        value = np.sqrt(np.mean(each**2)) if requirement.axis == "all" else np.max(each)
        result[name] = float(value) if np.isfinite(value) else None
    return result


def worst_axis(requirement: UnitRequirement, found: Residual) -> str | None:
    """Which element decides, where one does."""
    if requirement.axis == "all" or len(found.labels) < 2:
        return None
    return found.labels[int(np.argmax([statistic(requirement.statistic, v) for v in found.values]))]


def _elements(built: AssembledUnit, requirement: UnitRequirement, temperatures: np.ndarray, rates: np.ndarray):
    """Of each element of a quantity: label, (contrasts, those of what no calibration carries), prior variance of it."""
    model = built.model
    if isinstance(requirement, PositionRequirement | TiltRequirement | TurnRequirement):
        yield from _navigation(built, requirement, temperatures)
        return
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        yield from _internal(model, requirement, temperatures)
        return
    kind, terms = _TERMS[requirement.quantity]
    for c in model.channels:
        axis = AXIS_NAMES[c.axis]
        if c.kind != kind or requirement.axis in AXIS_NAMES and requirement.axis != axis:
            continue
        for term, label in terms(axis):
            yield label, *_map_rows(model, kind, c.axis, term, temperatures, rates)


_TERMS = {
    "gyro_bias": ("gyro", lambda a: [("bias", a)]),
    "gyro_scale_factor": ("gyro", lambda a: [(SCALE_FACTOR, a)]),
    "gyro_misalignment": ("gyro", lambda a: [(MISALIGNMENT.format(b), a + b) for b in AXIS_NAMES if b != a]),
    "g_sensitivity": ("gyro", lambda a: [(G_SENSITIVITY.format(b), a + b) for b in AXIS_NAMES]),
    "accelerometer_bias": ("accelerometer", lambda a: [(SPECIFIC_FORCE_BIAS, a)]),
    "accelerometer_scale_factor": ("accelerometer", lambda a: [(SCALE_FACTOR, a)]),
    "accelerometer_misalignment": (
        "accelerometer",
        lambda a: [(MISALIGNMENT.format(b), a + b) for b in AXIS_NAMES if b != a],
    ),
    "second_order": ("accelerometer", lambda a: [(SECOND_ORDER, a)]),
}


def _map_rows(model: UnitModel, kind: ChannelKind, axis: int, term: str, temperatures: np.ndarray, rates: np.ndarray):
    """Contrasts of one term of a channel on the grid."""
    channel = model.channel(kind, axis)
    assert channel is not None
    grid_t, grid_w = (g.ravel() for g in np.meshgrid(temperatures, rates, indexing="ij"))
    of, own = channel.model.term(term), model.where(kind, axis)
    rows = np.zeros((2, len(grid_t), model.size))
    if isinstance(of, Map):
        whole, alone, variance = contrasts(channel.model, term, grid_t, grid_w)  # pyright: ignore[reportArgumentType]
        rows[0][:, own], rows[1][:, own] = whole, alone
        return rows, variance if of.beyond is not None else None
    assert of is not None
    rows[0][:, model.where(kind, axis, term)] = of.temperature(grid_t)  # pyright: ignore[reportAttributeAccessIssue]
    return rows, None


def _row(model: UnitModel, kind: ChannelKind, axis: int, term: str, temperatures: np.ndarray) -> np.ndarray:
    """Contrasts `(n_T, p)` of a term at rate zero; zero where the model has it not."""
    channel = model.channel(kind, axis)
    if channel is None or channel.model.term(term) is None:
        return np.zeros((len(temperatures), model.size))
    return _map_rows(model, kind, axis, term, temperatures, np.zeros(1))[0][0]


def _internal(model: UnitModel, requirement: MisalignmentRequirement, temperatures: np.ndarray):
    """What no rotation of the unit changes: sums of opposite misalignments; of the accelerometers also the rotation of
    their triad against the gyros'.
    """
    kind: ChannelKind = "gyro" if requirement.quantity == "gyro_misalignment" else "accelerometer"

    def of(which: ChannelKind, i: int, j: int) -> np.ndarray:
        return _row(model, which, i, MISALIGNMENT.format(AXIS_NAMES[j]), temperatures)

    nothing = np.zeros((len(temperatures), model.size))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        name = AXIS_NAMES[i] + AXIS_NAMES[j]
        yield name, (of(kind, i, j) + of(kind, j, i), nothing), None
        if kind == "accelerometer":
            apart = of(kind, i, j) - of(kind, j, i) - of("gyro", i, j) + of("gyro", j, i)
            yield f"{name} to the gyros", (0.5 * apart, nothing), None


def _navigation(built: AssembledUnit, requirement, temperatures: np.ndarray):
    """Errors of navigation as linear functions of the calibration's errors; level, z up, at the site.

    At rest for t: along a horizontal axis ½t² of the accelerometer's error and, by the tilt that the gyros' errors
    build up, gt³/6 of the gyro's about the other (the Earth's rate and Schuler's period left out: t is short).
    """
    model, site = built.model, built.spec.rig.site
    g = float(site.gravity)
    earth = EARTH_RATE * np.array([0.0, np.cos(float(site.latitude)), np.sin(float(site.latitude))])

    def force(i: int) -> np.ndarray:
        rows = _row(model, "accelerometer", i, SPECIFIC_FORCE_BIAS, temperatures)
        rows = rows + g * _row(model, "accelerometer", i, MISALIGNMENT.format("z"), temperatures)
        return rows

    def rate(i: int) -> np.ndarray:
        rows = _row(model, "gyro", i, "bias", temperatures)
        rows = rows + g * _row(model, "gyro", i, G_SENSITIVITY.format("z"), temperatures)
        rows = rows + earth[i] * _row(model, "gyro", i, SCALE_FACTOR, temperatures)
        for j in range(3):
            if j != i:
                rows = rows + earth[j] * _row(model, "gyro", i, MISALIGNMENT.format(AXIS_NAMES[j]), temperatures)
        return rows

    nothing = np.zeros((len(temperatures), model.size))
    if isinstance(requirement, TiltRequirement):
        for i in (0, 1):
            yield AXIS_NAMES[i], (force(i) / g, nothing), None
    elif isinstance(requirement, PositionRequirement):
        t = float(requirement.after)
        for i, about, sign in ((0, 1, 1.0), (1, 0, -1.0)):
            yield AXIS_NAMES[i], (0.5 * t**2 * force(i) + sign * g * t**3 / 6.0 * rate(about), nothing), None
    else:
        turn, pace = float(requirement.turn), float(requirement.rate)
        rows, beyond = _map_rows(model, "gyro", 2, SCALE_FACTOR, temperatures, np.array([pace]))
        whole = turn * rows[0] + turn / pace * rate(2)
        yield "z", (whole, turn * rows[1]), None if beyond is None else turn**2 * beyond
