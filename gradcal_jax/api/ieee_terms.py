"""The uncertainty of a calibration file: residual maps as in predictions, and the terms of the standards.

Everything follows from the file's coefficients, their covariance `C` and the errors `v` that no residual shows: a
quantity that is linear in the coefficients, `cᵀβ`, has the standard deviation `√(cᵀCc + Σ(cᵀv)²)`. The names of terms
are those of IEEE 952, 1431 and 1780; each has its exact definition in words, since the standards leave room.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.api.posterior_of_plan import DEG_PER_H, DEG_PER_S, PPM, UNIT_OF, box
from gradcal_jax.files import Spec
from gradcal_jax.files.calibration import AxisCalibration, bias_names, scale_factor_names
from gradcal_jax.files.correction import basis_values
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.files.sensor import ScaleFactor

Floats = NDArray[np.float64]
# The temperature for figures of one temperature (°C), where the data cover it.
_ROOM = 25.0
_TEMPERATURES, _RATES = 101, 121


class IeeeTerm(NamedTuple):
    """A term of the standards. `std`: one sigma, None where it is not observable; `computed`: its definition."""

    name: str
    value: float
    std: float | None
    unit: str
    computed: str


class Box(NamedTuple):
    """Temperatures (°C) and rates (deg/s) of a residual map `(n_T, n_ω)` in `unit`; inf: not observable."""

    temperature_c: Floats
    rate_dps: Floats
    values: Floats
    unit: str


def calibration_map(axis: AxisCalibration, quantity: str, temperature_c: Floats, rate_dps: Floats) -> tuple[Box, Box]:
    """The map of a calibration and its standard deviation on a grid. Errors: `ValueError` for a map that it lacks."""
    unit, factor = UNIT_OF[quantity]
    grid_t, grid_w = np.meshgrid(temperature_c, rate_dps / DEG_PER_S, indexing="ij")
    names, rows = _rows(axis, quantity, grid_t.ravel(), grid_w.ravel())
    known = axis.values()
    values = rows @ np.array([known[name] for name in names])
    shape = grid_t.shape
    return (
        Box(temperature_c, rate_dps, values.reshape(shape) * factor, unit),
        Box(temperature_c, rate_dps, _deviations(axis, names, rows).reshape(shape) * factor, unit),
    )


def grid_of(axis: AxisCalibration, requirement: Requirement | None, quantity: str) -> tuple[Floats, Floats]:
    """Temperatures (°C) and rates (deg/s) of a requirement's box, or of all that the data cover."""
    cold, warm = axis.valid_temperature if requirement is None else requirement.temperature
    slow, fast = axis.valid_rate
    counts: tuple[int, ...] = (_TEMPERATURES, _RATES)
    if requirement is not None:
        counts = tuple(requirement.grid)
        if requirement.quantity == "scale_factor":
            slow, fast = requirement.rate
    temperatures = np.linspace(float(cold), float(warm), counts[0])
    if quantity == "bias":
        return temperatures, np.zeros(1)
    return temperatures, np.linspace(float(slow), float(fast), counts[1]) * DEG_PER_S


def prior_map(spec: Spec, requirement: Requirement) -> Box | None:
    """The prior standard deviation on a requirement's box, before any calibration; None where the prior is flat."""
    if requirement.quantity in ("heading", "north"):
        return None
    section = spec.sensor.bias if requirement.quantity == "bias" else spec.sensor.scale_factor
    if section is None or section.prior is None:
        return None
    unit, factor = UNIT_OF[requirement.quantity]
    temperatures, rates = box(requirement)
    over_temperature, over_rate = np.sum(basis_values(section.temperature, temperatures) ** 2, axis=1), np.ones(1)
    if isinstance(section, ScaleFactor):
        over_rate = np.sum(basis_values(section.rate, rates) ** 2, axis=1)
    values = np.sqrt(np.outer(over_temperature, over_rate)) * float(section.prior) * factor
    return Box(temperatures, rates * DEG_PER_S, values, unit)


def standard_terms(axis: AxisCalibration) -> list[IeeeTerm]:
    """The calibration of an axis in the vocabulary of IEEE 952, 1431 and 1780."""
    cold, warm = (float(end) for end in axis.valid_temperature)
    at = _ROOM if cold <= _ROOM <= warm else 0.5 * (cold + warm)
    temperatures = np.linspace(cold, warm, _TEMPERATURES)
    terms: list[IeeeTerm] = []
    if axis.bias is not None:
        here = _rows(axis, "bias", np.array([at]), np.zeros(1))
        terms.append(_term(axis, "bias", *here, DEG_PER_H, "deg/h", f"B at {at:g} °C"))
        if warm > cold:
            names, rows = _rows(axis, "bias", temperatures, np.zeros_like(temperatures))
            words = f"slope of the straight line through B, {cold:g} … {warm:g} °C"
            slope = _slope(temperatures) @ rows
            terms.append(_term(axis, "bias temperature sensitivity", names, slope[None], DEG_PER_H, "deg/h/°C", words))
    if axis.bias_temperature_gradient is not None:
        row = ["bias_temperature_gradient"], np.ones((1, 1))
        words = "bias for each °C/min of the temperature's rate"
        name = "bias temperature gradient sensitivity"
        terms.append(_term(axis, name, *row, DEG_PER_H / 60.0, "deg/h/(°C/min)", words))
    if axis.scale_factor is not None:
        terms += _scale_factor_terms(axis, at, temperatures)
    return terms


def _scale_factor_terms(axis: AxisCalibration, at: float, temperatures: Floats) -> list[IeeeTerm]:
    slow, fast = (float(end) for end in axis.valid_rate)
    rates = np.linspace(slow, fast, _RATES)
    names, rows = _rows(axis, "scale_factor", np.full_like(rates, at), rates)
    mean = rows.mean(axis=0)[None]
    terms = [_term(axis, "scale factor error", names, mean, PPM, "ppm", f"mean of M over rate at {at:g} °C")]
    if slow < 0.0 < fast:
        difference = rows[rates > 0.0].mean(axis=0) - rows[rates < 0.0].mean(axis=0)
        words = f"mean of M over positive rates less that over negative ones, at {at:g} °C"
        terms.append(_term(axis, "scale factor asymmetry", names, difference[None], PPM, "ppm", words))
    if fast > slow:
        # Output error M·ω less its best straight line, over the largest rate.
        line = np.stack([np.ones_like(rates), rates], axis=1)
        away = (np.eye(len(rates)) - line @ np.linalg.pinv(line)) @ (rows * rates[:, None]) / max(abs(slow), abs(fast))
        known = axis.values()
        worst = int(np.argmax(np.abs(away @ np.array([known[name] for name in names]))))
        words = (
            f"largest distance of the output from its best straight line, over the largest rate, at {at:g} °C "
            f"(at {rates[worst] * DEG_PER_S:.0f} deg/s)"
        )
        terms.append(_term(axis, "scale factor nonlinearity", names, away[worst][None], PPM, "ppm", words))
    if temperatures[-1] > temperatures[0]:
        grid_t, grid_w = np.meshgrid(temperatures, rates, indexing="ij")
        names, rows = _rows(axis, "scale_factor", grid_t.ravel(), grid_w.ravel())
        over_rate = rows.reshape(len(temperatures), len(rates), -1).mean(axis=1)
        words = f"slope of the straight line through M's mean over rate, {temperatures[0]:g} … {temperatures[-1]:g} °C"
        slope = (_slope(temperatures) @ over_rate)[None]
        terms.append(_term(axis, "scale factor temperature sensitivity", names, slope, PPM, "ppm/°C", words))
    return terms


def _slope(x: Floats) -> Floats:
    """Weights of the least-squares slope."""
    centred = x - x.mean()
    return centred / (centred @ centred)


def _term(axis: AxisCalibration, name: str, names, rows: Floats, factor: float, unit: str, computed: str) -> IeeeTerm:
    known = axis.values()
    value = float((rows @ np.array([known[n] for n in names]))[0]) * factor
    std = float(_deviations(axis, names, rows)[0]) * factor
    return IeeeTerm(name, value, std if np.isfinite(std) else None, unit, computed)


def _rows(axis: AxisCalibration, quantity: str, temperature_c: Floats, rate: Floats) -> tuple[list[str], Floats]:
    """Names of coefficients and the functions `(g, p)` that they multiply."""
    if quantity == "bias":
        if axis.bias is None:
            raise ValueError(f"the calibration of axis {axis.name} holds no bias")
        return bias_names(axis.bias.temperature), basis_values(axis.bias.temperature, temperature_c)
    if (of := axis.scale_factor) is None:
        raise ValueError(f"the calibration of axis {axis.name} holds no scale factor")
    cold, fast = basis_values(of.temperature, temperature_c), basis_values(of.rate, rate)
    return scale_factor_names(of.temperature, of.rate), (cold[:, :, None] * fast[:, None, :]).reshape(len(rate), -1)


def _deviations(axis: AxisCalibration, names: list[str], rows: Floats) -> Floats:
    """One sigma of each row; `inf` where it involves a coefficient that is not observable."""
    if axis.covariance is None:
        return np.full(len(rows), np.inf)
    place = {name: k for k, name in enumerate(axis.covariance.names)}
    matrix = np.array(axis.covariance.matrix)
    seen = [k for k, name in enumerate(names) if name in place]
    where = [place[names[k]] for k in seen]
    part = rows[:, seen]
    variance = np.maximum(np.einsum("gi,ij,gj->g", part, matrix[np.ix_(where, where)], part), 0.0)
    for error in axis.unseen:
        variance = variance + (rows @ np.array([error.coefficients.get(name, 0.0) for name in names])) ** 2
    deviations = np.sqrt(variance)
    unseen = np.delete(rows, seen, axis=1)
    return np.where(np.any(unseen != 0.0, axis=1), np.inf, deviations)
