"""Coefficients of a calibration, or of a plan alone, beside predicted uncertainties and a simulation's true values."""

import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.api.contract_rows import deviations_of
from gradcal_jax.api.posterior_of_plan import DEG_PER_H, PPM
from gradcal_jax.files.calibration import AxisCalibration, Calibration, Covariance
from gradcal_jax.files.recipe import Recipe

# The temperature-gradient sensitivity has other names in predictions and in a simulation's truth.
_GRADIENT: Final = "bias_temperature_gradient"
_SUPERSCRIPTS: Final = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class ParameterFact(NamedTuple):
    """A coefficient in `unit`, the function that it multiplies, its estimated and predicted one sigma, and the true
    value of a simulation."""

    name: str
    axis: str
    multiplies: str
    unit: str
    value: float | None
    std: float | None
    predicted_std: float | None
    truth: float | None
    off_by_sigma: float | None


def parameters(
    recipe: Recipe | None, calibration: Calibration | None, truth: dict[str, Any] | None
) -> list[ParameterFact]:
    """Every coefficient of a calibration, or of a recipe's plan alone, beside the true values of a simulation."""
    known = () if recipe is None else recipe.prediction.parameters
    predicted = {(row.axis, row.name if re.match(r"[ab][\d_]", row.name) else _GRADIENT): row for row in known}
    if calibration is None:
        return [_fact(name, axis, None, None, row.std, None) for (axis, name), row in predicted.items()]
    rows: list[ParameterFact] = []
    for axis in calibration.axis:
        hidden, deviations = hidden_of(axis, truth), deviations_of(axis.covariance)
        for name, value in axis.values().items():
            row, std = predicted.get((axis.name, name)), deviations.get(name)
            rows.append(_fact(name, axis.name, value, std, None if row is None else row.std, hidden.get(name)))
    return rows


def hidden_of(axis: AxisCalibration, truth: dict[str, Any] | None) -> dict[str, float]:
    """The true values of a simulated axis, by the names of a calibration."""
    hidden = (truth or {}).get(axis.name) or {}
    return {_GRADIENT if name == "gradient" else name: value for name, value in hidden.items()}


def parameter_fact(
    name: str, axis: str, multiplies: str, unit: str, factor: float, *numbers: float | None
) -> ParameterFact:
    """A coefficient in `unit`, of which `factor` are one in SI. `numbers` (SI): value, one sigma, predicted one sigma,
    truth."""
    value, std, _, truth = numbers
    off = None if value is None or truth is None or not std else (value - truth) / std
    value, std, predicted, truth = (None if number is None else number * factor for number in numbers)
    return ParameterFact(name, axis, multiplies, unit, value, std, predicted, truth, off)


def _fact(name: str, axis: str, *numbers: float | None) -> ParameterFact:
    return parameter_fact(name, axis, _multiplies(name), *_factor(name), *numbers)


def _factor(name: str) -> tuple[str, float]:
    if name == _GRADIENT:
        return "deg/h/(°C/min)", DEG_PER_H / 60.0
    return ("deg/h", DEG_PER_H) if name.startswith("a") else ("ppm", PPM)


def _multiplies(name: str) -> str:
    """The function that a coefficient multiplies: powers of T′ and ω′; for other bases the number of the function."""
    if name == _GRADIENT:
        return "dT/dt"
    if (match := re.fullmatch(r"a(\d+)", name)) is not None:
        return _power("T′", match[1]) or "1"
    if (match := re.fullmatch(r"b(\d)(\d)", name)) or (match := re.fullmatch(r"b(\d+)_(\d+)", name)):
        return "·".join(part for part in (_power("ω′", match[1]), _power("T′", match[2])) if part) or "1"
    return "function " + name[1:].strip("_").replace("_", " × ")


def _power(symbol: str, exponent: str) -> str:
    return "" if exponent == "0" else symbol if exponent == "1" else symbol + exponent.translate(_SUPERSCRIPTS)


def agreement(
    values: Mapping[str, float], known: Covariance | None, hidden: Mapping[str, float]
) -> tuple[float, int, float] | None:
    """χ² of the errors of all coefficients by the estimate's covariance, its degrees of freedom, and the probability of
    a larger one; None where a true value is not known."""
    if known is None or not all(name in hidden for name in known.names):
        return None
    from scipy.special import chdtrc

    error, covariance = np.array([values[name] - hidden[name] for name in known.names]), np.array(known.matrix)
    size = np.sqrt(np.diag(covariance))
    whitened = np.linalg.solve(np.linalg.cholesky(covariance / np.outer(size, size)), error / size)
    chi_squared = float(whitened @ whitened)
    return chi_squared, len(error), float(chdtrc(len(error), chi_squared))
