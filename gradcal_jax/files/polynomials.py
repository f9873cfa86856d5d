"""Maps of any basis as polynomials, for targets without other bases: exact for polynomials, otherwise fitted."""

import numpy as np
from numpy.polynomial import polynomial

from gradcal_jax.files import correction
from gradcal_jax.files.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.files.calibration import AxisCalibration, bias_names
from gradcal_jax.files.log import Floats

_POINTS = 201
_FIT_DEGREE = 7
_SMALL_GRID = 41


def bias_polynomial(axis: AxisCalibration, about_c: float, degree: int) -> Floats:
    """B(T) in powers of (T − about), `(degree + 1,)`; a fit over the axis's range where it is no such polynomial."""
    result = np.zeros(degree + 1)
    part = axis.bias
    if part is None:
        return result
    basis = part.temperature
    if isinstance(basis, TemperaturePolynomial) and basis.degree <= degree:
        values = [part.coefficients[name] for name in bias_names(basis)]
        moved = _moved(np.array(values), float(basis.centre), float(basis.scale), about_c)
        result[: len(moved)] = moved
        return result
    low, high = float(axis.valid_temperature[0]), float(axis.valid_temperature[1])
    t = np.linspace(low, high, _POINTS)
    middle, half = 0.5 * (low + high), max(0.5 * (high - low), 1e-9)
    # Chebyshev inside, for its conditioning; powers outside.
    fitted = np.polynomial.chebyshev.chebfit((t - middle) / half, correction.bias(axis, t), degree)
    return _moved(np.asarray(np.polynomial.chebyshev.cheb2poly(fitted), np.float64), middle, half, about_c)


def _moved(coefficients: Floats, centre: float, scale: float, about: float) -> Floats:
    """Powers of (x − centre)/scale as powers of (x − about)."""
    inner = np.array([(about - centre) / scale, 1.0 / scale])
    total, power = np.zeros(len(coefficients)), np.ones(1)
    for value in coefficients:
        total[: len(power)] += value * power
        power = polynomial.polymul(power, inner)
    return total


def normalised_bias(axis: AxisCalibration) -> tuple[float, float, Floats]:
    """`(centre, scale, coefficients)` of B in powers of (T − centre)/scale."""
    low, high = float(axis.valid_temperature[0]), float(axis.valid_temperature[1])
    part = axis.bias
    if part is None:
        return 0.0, 1.0, np.zeros(1)
    basis = part.temperature
    if isinstance(basis, TemperaturePolynomial):
        values = np.array([part.coefficients[name] for name in bias_names(basis)])
        return float(basis.centre), float(basis.scale), values
    centre, scale = 0.5 * (low + high), max(0.5 * (high - low), 1e-9)
    plain = bias_polynomial(axis, centre, _FIT_DEGREE)
    return centre, scale, plain * scale ** np.arange(len(plain))


def normalised_scale_factor(axis: AxisCalibration) -> tuple[tuple[float, float], tuple[float, float], Floats]:
    """`((centre, scale) of T, (centre, scale) of ω, coefficients (n_T, n_ω))` of M in normalised powers."""
    part = axis.scale_factor
    if part is None:
        return (0.0, 1.0), (0.0, 1.0), np.zeros((1, 1))
    of_t, of_w = part.temperature, part.rate
    if isinstance(of_t, TemperaturePolynomial) and isinstance(of_w, RatePolynomial):
        table = correction.scale_factor_table(part)
        return (float(of_t.centre), float(of_t.scale)), (float(of_w.centre), float(of_w.scale)), table
    sides: list[tuple[float, float]] = []
    for low, high in (axis.valid_temperature, axis.valid_rate):
        sides.append((0.5 * (float(low) + float(high)), max(0.5 * (float(high) - float(low)), 1e-9)))
    (t0, ts), (w0, ws) = sides
    u = np.linspace(-1.0, 1.0, _SMALL_GRID)
    grid_t, grid_w = np.meshgrid(u, u, indexing="ij")
    values = correction.scale_factor(axis, t0 + ts * grid_t.ravel(), w0 + ws * grid_w.ravel())
    degree_t, degree_w = min(of_t.size - 1, _FIT_DEGREE), min(of_w.size - 1, _FIT_DEGREE)
    design = np.polynomial.chebyshev.chebvander2d(grid_t.ravel(), grid_w.ravel(), [degree_t, degree_w])
    fitted = np.linalg.lstsq(design, values, rcond=None)[0].reshape(degree_t + 1, degree_w + 1)
    to_power = [np.zeros((d + 1, d + 1)) for d in (degree_t, degree_w)]
    for matrix in to_power:
        for k in range(len(matrix)):
            powers: Floats = np.asarray(np.polynomial.chebyshev.cheb2poly(np.eye(len(matrix))[k]), np.float64)
            matrix[: len(powers), k] = powers
    return sides[0], sides[1], to_power[0] @ fitted @ to_power[1].T
