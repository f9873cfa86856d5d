"""Coefficients of a calibration, or of a plan alone, beside predicted uncertainties and a simulation's true values."""

import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.api.contract_rows import coefficient_rows
from gradcal_jax.api.unit_residual import UNITS_OF_TERMS
from gradcal_jax.files.calibration import Calibration, Covariance
from gradcal_jax.files.contracts import Prediction
from gradcal_jax.files.recipe import Recipe

# The temperature-gradient sensitivity has other names in predictions and in a simulation's truth.
_GRADIENT: Final = "bias_temperature_gradient"
_SUPERSCRIPTS: Final = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class ParameterFact(NamedTuple):
    """A coefficient of a channel in `unit`, the function that it multiplies, its estimated and predicted one sigma, and
    the true value of a simulation."""

    name: str
    kind: str
    axis: str
    multiplies: str
    unit: str
    value: float | None
    std: float | None
    predicted_std: float | None
    truth: float | None
    off_by_sigma: float | None


def predicted_deviations(recipe: Recipe | None, prediction: Prediction | None) -> dict[str, tuple[float | None, str]]:
    """One sigma of every predicted coefficient, and its SI unit, by its name in a calibration file."""
    rows = () if recipe is None else recipe.prediction.parameters
    named = {f"gyro_{r.axis}.{r.name if re.match(r'[ab][0-9_]', r.name) else _GRADIENT}": r for r in rows}
    named |= {} if prediction is None else {row.name: row for row in prediction.parameters}
    return {name: (row.std, row.unit) for name, row in named.items()}


def parameters(
    predicted: Mapping[str, tuple[float | None, str]], calibration: Calibration | None, hidden: Mapping[str, float]
) -> list[ParameterFact]:
    """Every coefficient of a calibration, or of a plan alone, beside the true values of a simulation."""
    if calibration is None:
        return [parameter_fact(name, unit, None, None, std, None) for name, (std, unit) in predicted.items()]
    facts: list[ParameterFact] = []
    for row in coefficient_rows(calibration):
        std, _ = predicted.get(row["name"], (None, ""))
        facts.append(parameter_fact(row["name"], row["unit"], row["value"], row["std"], std, hidden.get(row["name"])))
    return facts


def estimated_coefficients(calibration: Calibration) -> tuple[list[tuple[str, ...]], tuple[int, ...]]:
    """The coefficients of a calibration after a head, and the numbers of the columns that are flush right. Where it
    has errors that no residual shows, they count in one sigma, beside that of the fit."""
    rows: list[tuple[str, ...]] = [("parameter", "value", "1σ", "of the fit", "unit")]
    for row in coefficient_rows(calibration):
        unit, factor = UNITS_OF_TERMS.get(row["unit"], (row["unit"], 1.0))
        if row["std"] is None:
            rows.append((row["name"], "not observable", "", "", unit))
        else:
            stds = (f"{row[key] * factor:.4g}" for key in ("std_counted", "std"))
            rows.append((row["name"], f"{row['value'] * factor:.4f}", *stds, unit))
    return (rows, (1, 2, 3)) if calibration.unseen else ([(*row[:3], row[4]) for row in rows], (1, 2))


def hidden_values(truth: Mapping[str, Any] | None, calibration: Calibration | None) -> dict[str, float]:
    """The true values of a simulated sensor and table, by the names of a calibration file."""
    if truth is None or calibration is None:
        return {}
    if "units" in truth:
        return truth.get("installation", {}) | truth["units"].get(calibration.serial_number, {})
    return {
        f"gyro_{axis}.{_GRADIENT if name == 'gradient' else name}": value
        for axis, values in truth.items()
        if isinstance(values, dict)
        for name, value in values.items()
    }


def parameter_fact(full_name: str, si: str, *numbers: float | None) -> ParameterFact:
    """A coefficient for people. `numbers` (SI): value, one sigma, predicted one sigma, truth."""
    channel, _, name = full_name.partition(".")
    kind, _, axis = channel.partition("_")
    unit, factor = UNITS_OF_TERMS.get(si, (si, 1.0))
    value, std, _, truth = numbers
    off = None if value is None or truth is None or not std else (value - truth) / std
    value, std, predicted, truth = (None if number is None else number * factor for number in numbers)
    return ParameterFact(name, kind, axis, _multiplies(name), unit, value, std, predicted, truth, off)


def _multiplies(name: str) -> str:
    """The function that a coefficient multiplies: powers of T′ and ω′; for other bases the number of the function."""
    if name == _GRADIENT:
        return "dT/dt"
    if (match := re.fullmatch(r"b(\d)(\d)", name)) or (match := re.fullmatch(r"b(\d+)_(\d+)", name)):
        return "·".join(part for part in (_power("ω′", match[1]), _power("T′", match[2])) if part) or "1"
    if re.match(r"a_|b\d*_", name):
        return "function " + name[1:].strip("_").replace("_", " × ")
    match = re.fullmatch(r"(?:a|s|[mg]_[a-z])(\d+)", name)
    return (_power("T′", match[1]) if match else "") or "1"


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
