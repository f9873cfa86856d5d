"""A finished calibration: its maps with their uncertainty, and its parameters for a model.

Everything follows from the file's coefficients, their covariance `C` and the errors `v` that no residual shows: a
quantity that is linear in the coefficients, `cᵀβ`, has the standard deviation `√(cᵀCc + Σ(cᵀv)²)`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.calibration.file import CalibratedChannel, Calibration
from gradcal_jax.information import Posterior
from gradcal_jax.information.residual import UNITS_OF_TERMS
from gradcal_jax.model import ImuModel
from gradcal_jax.units import DEG_PER_S

Floats = Float[np.ndarray, "..."]

_TEMPERATURES, _RATES = 101, 121


class Box(NamedTuple):
    """Temperatures (°C) and rates (deg/s) of a residual map `(n_T, n_ω)` in `unit`; inf: not observable."""

    temperature_c: Floats
    rate_dps: Floats
    values: Floats
    unit: str


def calibration_map(
    calibration: Calibration, channel: CalibratedChannel, name: str, temperature_c: Floats, rate_dps: Floats
) -> tuple[Box, Box]:
    """A term of a calibration and its standard deviation on a grid; `inf` where it involves a coefficient that is not
    observable. Errors: `ValueError` for a term that it lacks."""
    if (term := channel.term_of(name)) is None:
        raise ValueError(f"the calibration of {channel.label} has no {name.replace('_', ' ')}")
    cold = np.ones((len(temperature_c), 1)) if term.temperature is None else term.temperature.values(temperature_c)
    fast = np.ones((len(rate_dps), 1)) if term.rate is None else term.rate.values(rate_dps / DEG_PER_S)
    rows = np.einsum("ti,wj->twij", cold, fast).reshape(len(cold) * len(fast), -1)
    names = [f"{channel.name}.{of}" for of in term.coefficients]
    known = calibration.covariance
    place = {} if known is None else {of: k for k, of in enumerate(known.names)}
    seen = [k for k, of in enumerate(names) if of in place]
    variance = np.zeros(len(rows))
    if known is not None and seen:
        where, part = [place[names[k]] for k in seen], rows[:, seen]
        block = np.array(known.matrix)[np.ix_(where, where)]
        variance = np.maximum(np.einsum("gi,ij,gj->g", part, block, part), 0.0)
    for error in calibration.unseen:
        variance = variance + (rows @ np.array([error.coefficients.get(of, 0.0) for of in names])) ** 2
    hidden = np.any(np.delete(rows, seen, axis=1) != 0.0, axis=1)
    unit, factor = UNITS_OF_TERMS.get(term.unit, (term.unit, 1.0))
    both = rows @ np.array(list(term.coefficients.values())), np.where(hidden, np.inf, np.sqrt(variance))
    first, second = (
        Box(temperature_c, rate_dps, values.reshape(len(cold), len(fast)) * factor, unit) for values in both
    )
    return first, second


def grid_of(channel: CalibratedChannel, name: str) -> tuple[Floats, Floats]:
    """Temperatures (°C) and rates (deg/s) of all that the data cover for a term."""
    cold, warm = channel.valid_temperature
    slow, fast = channel.valid_rate
    temperatures = np.linspace(float(cold), float(warm), _TEMPERATURES)
    term = channel.term_of(name)
    if term is None or term.rate is None:
        return temperatures, np.zeros(1)
    return temperatures, np.linspace(float(slow), float(fast), _RATES) * DEG_PER_S


def calibrated_parameters(model: ImuModel, calibration: Calibration) -> np.ndarray:
    """The parameters of a model by a calibration file; zero for what it does not carry."""
    carried = calibration.values()
    return np.linalg.solve(model.to_reported, [carried.get(name, 0.0) for name in model.names()])


def calibrated_posterior(model: ImuModel, calibration: Calibration) -> Posterior:
    """The posterior of a model's parameters by a calibration file: the covariance of its coefficients, and the errors
    that no residual shows. Coefficients without a variance are hidden; what the file does not carry has no error."""
    names, carried, known = model.names(), calibration.values(), calibration.covariance
    place = {name: k for k, name in enumerate(names)}
    seen = () if known is None else known.names
    columns = [np.zeros((model.size, 0))]
    if known is not None and any(name in place for name in seen):
        own = [k for k, name in enumerate(seen) if name in place]
        matrix = np.array(known.matrix)[np.ix_(own, own)]
        size = np.sqrt(np.diag(matrix))
        values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
        root = np.zeros((model.size, len(own)))
        root[[place[seen[k]] for k in own]] = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        columns.append(root)
    for error in calibration.unseen:
        columns.append(np.array([[error.coefficients.get(name, 0.0)] for name in names]))
    # Of the engine's own parameters.
    back = np.linalg.inv(model.to_reported)
    hidden = back[:, [place[name] for name in carried if name in place and name not in seen]]
    return Posterior(back @ np.concatenate(columns, axis=1), hidden / np.linalg.norm(hidden, axis=0))
