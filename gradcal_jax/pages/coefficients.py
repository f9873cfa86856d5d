"""Coefficients of a calibration, or of a plan alone, beside predicted uncertainties and a simulation's true values."""

import re
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration import FRAME_OF_CASE, Calibration
from gradcal_jax.information.error_budget import OFF_THERMOMETER
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.information.verdicts import coefficient_rows
from gradcal_jax.model import TEMPERATURE_GRADIENT
from gradcal_jax.pages.numbers import figures, with_uncertainty
from gradcal_jax.recipe.recipe import Predicted
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import Prediction

# Of more channels a table has a column for each axis.
_MOST_CHANNELS: Final = 3
_SYMBOLS: Final = (
    "a: bias; b (followed by the powers of rate and temperature) or s: scale factor; m: misalignment towards an "
    "axis; g: bias caused by a specific force along an axis; k2: second order. Digits at the end are powers of "
    "temperature."
)
# Over the range of a calibration, for a change of its maps.
_TEMPERATURES: Final = 64
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


def parameters(
    planned: Predicted | Prediction | None, calibration: Calibration | None, hidden: Mapping[str, float]
) -> list[ParameterFact]:
    """Every coefficient of a calibration, or of a plan alone, beside the true values of a simulation."""
    predicted = {} if planned is None else {row.name: row for row in planned.parameters}
    if calibration is None:
        return [_fact(name, row.unit, None, None, row.std, None) for name, row in predicted.items()]
    facts: list[ParameterFact] = []
    for row in coefficient_rows(calibration):
        std = predicted[row["name"]].std if row["name"] in predicted else None
        facts.append(_fact(row["name"], row["unit"], row["value"], row["std"], std, hidden.get(row["name"])))
    return facts


def coefficient_table(facts: Sequence[ParameterFact]) -> tuple[list[tuple[str, ...]], tuple[int, ...]]:
    """Coefficients after a head, and the numbers of the columns that are flush right: of few channels a row each with
    all that is known of it, of more a column an axis."""
    channels = {(row.kind, row.axis) for row in facts}
    return _each(facts, len(channels) > 1) if len(channels) <= _MOST_CHANNELS else (_by_axis(facts), (1, 2, 3))


def symbols(spec: Spec | None, calibration: Calibration | None) -> str:
    """What the names of coefficients mean, and T′ and ω′."""
    terms: list[Any] = [] if calibration is None else [term for c in calibration.channel for term in c.term]
    if spec is not None:
        triads = [t for t in (spec.sensor.gyro, spec.sensor.accelerometer) if t is not None]
        terms = [getattr(triad, name) for triad in triads for name in type(triad).model_fields]
    words = [_SYMBOLS]
    for symbol, plain, name in (("T′", "T", "temperature"), ("ω′", "ω", "rate")):
        bases = [of for term in terms if (of := getattr(term, name, None)) is not None]
        scaled = {f"({plain} − {of.centre}) / {of.scale}" for of in bases if of.basis == "polynomial"}
        if len(scaled) == 1:
            words.append(f"{symbol} = {scaled.pop()}.")
        elif scaled:
            words.append(f"{symbol} = ({plain} − centre) / scale of each term.")
    return " ".join(words)


def _each(facts: Sequence[ParameterFact], several: bool) -> tuple[list[tuple[str, ...]], tuple[int, ...]]:
    # Head, the field that must have a value, the shown field, its digits, text for none, suffix.
    columns = (
        ("value", "value", "value", 6, "", ""),
        ("1σ", "value", "std", 4, "not observable", ""),
        ("1σ predicted", "predicted_std", "predicted_std", 4, "", ""),
        ("hidden truth", "truth", "truth", 6, "", ""),
        ("off by", "off_by_sigma", "off_by_sigma", 2, "", " σ"),
    )
    kept = [column for column in columns if any(getattr(row, column[1]) is not None for row in facts)]
    if not any(row.value is not None for row in facts):
        kept = [("1σ", "predicted_std", "predicted_std", 4, "not observable", "")]
    rows = [
        (
            f"{row.kind} {row.axis}: {row.name}" if several else row.name,
            row.multiplies,
            *(
                none if (value := getattr(row, name)) is None else figures(value, digits) + after
                for _, _, name, digits, none, after in kept
            ),
            row.unit,
        )
        for row in facts
    ]
    head = ("parameter", "multiplies", *(head for head, *_ in kept), "unit")
    return [head, *rows], tuple(range(2, 2 + len(kept)))


def _by_axis(facts: Sequence[ParameterFact]) -> list[tuple[str, ...]]:
    table: dict[tuple[str, str, str], dict[str, str]] = {}
    for row in facts:
        text = "not observable" if row.predicted_std is None else figures(row.predicted_std)
        if row.value is not None:
            text = "not observed" if row.std is None else with_uncertainty(row.value, row.std)
            text += "" if row.off_by_sigma is None else f" ({figures(row.off_by_sigma, 2)}σ)"
        table.setdefault((row.kind, row.name, row.unit), {})[row.axis] = text
    first = "parameter ± 1σ" if any(row.value is not None for row in facts) else "parameter, 1σ"
    first += " (off by)" if any(row.truth is not None for row in facts) else ""
    rows = [
        (f"{kind} {symbol}", *(values.get(axis, "") for axis in "xyz"), unit)
        for (kind, symbol, unit), values in table.items()
    ]
    return [(first, "x", "y", "z", "unit"), *rows]


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
    devices = truth["units"]
    # A device has another name in its calibration where somebody has written its serial number there.
    only = next(iter(devices.values())) if len(devices) == 1 else {}
    return truth["installation"] | devices.get(calibration.serial_number, only)


def _fact(full_name: str, si: str, *numbers: float | None) -> ParameterFact:
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
    if name == TEMPERATURE_GRADIENT:
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
    calibration: Calibration, hidden: Mapping[str, float], walked: float = 0.0
) -> tuple[float, int, float] | None:
    """χ² of the errors of all coefficients, its degrees of freedom, and the probability of a larger one; None where a
    true value is not known. The covariance is that of the estimate with the errors that no residual shows, and with the
    standard deviation (rad/s) by which the gyros have `walked` before the data: a true bias is that of power-on. The
    offset of a simulated thermometer is known: true values are those at the temperature that it shows, since of some
    kelvins the curvature of the maps counts. If the frame of the estimate is known only as accurately as the mounting,
    the true values are rotated into it: by the rotation with the smallest χ², which takes three degrees of freedom."""
    known = calibration.covariance
    if known is None or not all(name in hidden for name in known.names):
        return None
    from scipy.optimize import least_squares
    from scipy.special import chdtrc

    shown = _at_shown_temperatures(calibration, hidden)
    counted = [e for e in calibration.unseen if shown is hidden or e.name != OFF_THERMOMETER]
    columns = [[e.coefficients.get(n, 0.0) for n in known.names] for e in counted]
    for axis in "xyz":
        bias = re.compile(rf"gyro_{axis}\.a(0|_(bin|spline)\d+)?")
        columns.append([walked * (bias.fullmatch(n) is not None) for n in known.names])
    unseen = np.array(columns)
    covariance = np.array(known.matrix) + unseen.T @ unseen
    size = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(size, size))
    values = calibration.values()

    def whitened(rotation: np.ndarray) -> np.ndarray:
        truth = _rotated(shown, rotation)
        return np.linalg.solve(root, np.array([values[n] - truth[n] for n in known.names]) / size)

    degrees, best = len(known.names), np.zeros(3)
    if calibration.frame == FRAME_OF_CASE and all(f"gyro_{axis}" in " ".join(known.names) for axis in "xyz"):
        # (In steps of a milliradian.)
        best, degrees = least_squares(lambda turn: whitened(1e-3 * turn), best).x * 1e-3, degrees - 3
    chi_squared = float(np.sum(whitened(best) ** 2))
    return chi_squared, degrees, float(chdtrc(degrees, chi_squared))


def _at_shown_temperatures(calibration: Calibration, hidden: Mapping[str, float]) -> Mapping[str, float]:
    """True values as functions of the temperature that the simulated thermometer shows, off by a constant."""
    if not (offset := hidden.get("temperature_offset", 0.0)):
        return hidden
    found = dict(hidden)
    for channel in calibration.channel:
        low, high = map(float, channel.valid_temperature)
        at = np.linspace(low, high, _TEMPERATURES)
        for term in channel.term:
            names = [f"{channel.kind}_{channel.axis}.{name}" for name in term.coefficients]
            if term.temperature is not None and all(name in hidden for name in names):
                functions, true = term.temperature.values(at), term.temperature.values(at - offset)
                # A map over rate is written temperature by temperature.
                of = np.array([hidden[name] for name in names]).reshape(functions.shape[1], -1)
                found |= zip(names, np.linalg.lstsq(functions, true @ of, rcond=None)[0].ravel().tolist(), strict=True)
    return found


def _rotated(truth: Mapping[str, float], rotation: np.ndarray) -> dict[str, float]:
    """True values in a frame that is rotated by a vector (rad): misalignments, sensitivities to g, and the scale
    factors, each multiplied by the component along its own axis. (Parts that vary over temperature are small, and a
    small rotation changes them by nothing that could be seen.)"""
    if not np.any(rotation):
        return dict(truth)
    from scipy.spatial.transform import Rotation

    matrix, found = Rotation.from_rotvec(rotation).as_matrix(), dict(truth)
    for kind, i in product(("gyro", "accelerometer"), range(3)):
        channel = f"{kind}_{'xyz'[i]}"
        across = [_constant(truth, f"{channel}.m_{axis}") for axis in "xyz"]
        along = np.array([1.0 if k == i else truth.get(name, 0.0) for k, name in enumerate(across)]) @ matrix
        found |= {name: along[k] / along[i] for k, name in enumerate(across) if k != i and name in truth}
        for name in (f"{channel}.b00", f"{channel}.s0"):
            found |= {name: (1.0 + truth[name]) * along[i] - 1.0} if name in truth else {}
        names = [_constant(truth, f"{channel}.g_{axis}") for axis in "xyz"]
        by_force = np.array([truth.get(name, 0.0) for name in names]) @ matrix
        found |= {name: value for name, value in zip(names, by_force, strict=True) if name in truth}
    return found


def _constant(truth: Mapping[str, float], name: str) -> str:
    """The coefficient of a term that does not vary over temperature, or the first one of a term that does."""
    return f"{name}0" if f"{name}0" in truth else name
