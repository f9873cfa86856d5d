"""Maps of any basis as polynomials, for targets without other bases: exact for polynomials, otherwise fitted."""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from gradcal_jax.calibration.correction import term_values
from gradcal_jax.calibration.file import CalibratedChannel, CalibratedTerm
from gradcal_jax.records.log import Floats
from gradcal_jax.spec.bases import PolynomialKeys

_POINTS, _SMALL_GRID = 201, 41
_FIT_DEGREE = 7


class PowerForm(NamedTuple):
    """Centre and scale of temperature (°C, K) and of rate (rad/s), and a map's coefficients `(n_T, n_ω)` in powers of
    the normalised variables; `exact`: whether the map is this polynomial."""

    temperature: tuple[float, float]
    rate: tuple[float, float]
    table: Floats
    exact: bool


def bias_polynomial(channel: CalibratedChannel, about_c: float, degree: int) -> Floats:
    """B(T) in powers of (T − about), `(degree + 1,)`; a fit over the channel's range where it is no such polynomial."""
    result = np.zeros(degree + 1)
    term = channel.term_of("bias")
    if term is None:
        return result
    basis = term.temperature
    if basis is None or (isinstance(basis, PolynomialKeys) and basis.degree <= degree):
        centre, scale = (0.0, 1.0) if basis is None else (float(basis.centre), float(basis.scale))
        moved = _moved(np.array(list(term.coefficients.values())), centre, scale, about_c)
        result[: len(moved)] = moved
        return result
    middle, half = _side(channel.valid_temperature)
    t = np.linspace(float(channel.valid_temperature[0]), float(channel.valid_temperature[1]), _POINTS)
    # Chebyshev inside, for its conditioning; powers outside.
    fitted = chebyshev.chebfit((t - middle) / half, term_values(term, t), degree)
    return _moved(np.asarray(chebyshev.cheb2poly(fitted), np.float64), middle, half, about_c)


def _moved(coefficients: Floats, centre: float, scale: float, about: float) -> Floats:
    """PowerForm of (x − centre)/scale as powers of (x − about)."""
    inner = np.array([(about - centre) / scale, 1.0 / scale])
    total, power = np.zeros(len(coefficients)), np.ones(1)
    for value in coefficients:
        total[: len(power)] += value * power
        power = polynomial.polymul(power, inner)
    return total


def in_powers(channel: CalibratedChannel, term: CalibratedTerm) -> PowerForm:
    """A term's map in normalised powers; fitted over the channel's range where it is no polynomial."""
    of_t, of_w = term.temperature, term.rate
    sides, degrees, exact = [(0.0, 1.0), (0.0, 1.0)], [0, 0], True
    spans = (channel.valid_temperature, channel.valid_rate)
    for k, (basis, span) in enumerate(zip((of_t, of_w), spans, strict=True)):
        if isinstance(basis, PolynomialKeys):
            sides[k], degrees[k] = (float(basis.centre), float(basis.scale)), basis.degree
        elif basis is not None:
            sides[k], degrees[k], exact = _side(span), _FIT_DEGREE, False
    if exact:
        table = np.array(list(term.coefficients.values())).reshape(degrees[0] + 1, degrees[1] + 1)
        return PowerForm(sides[0], sides[1], table, True)
    t, w = (np.linspace(float(low), float(high), _SMALL_GRID) for low, high in spans)
    grid_t, grid_w = (x.ravel() for x in np.meshgrid(t, w, indexing="ij"))
    normalised = [(x - centre) / scale for x, (centre, scale) in zip((grid_t, grid_w), sides, strict=True)]
    design = chebyshev.chebvander2d(normalised[0], normalised[1], degrees)
    fitted = np.linalg.lstsq(design, term_values(term, grid_t, grid_w), rcond=None)[0]
    to_powers = [np.stack([_chebyshev_powers(k, d + 1) for k in range(d + 1)], axis=1) for d in degrees]
    table = to_powers[0] @ fitted.reshape(degrees[0] + 1, degrees[1] + 1) @ to_powers[1].T
    return PowerForm(sides[0], sides[1], table, False)


def _side(span: tuple[float, float]) -> tuple[float, float]:
    """Middle and half of a range."""
    return 0.5 * (float(span[0]) + float(span[1])), max(0.5 * (float(span[1]) - float(span[0])), 1e-9)


def _chebyshev_powers(order: int, size: int) -> Floats:
    """A Chebyshev polynomial in powers, `(size,)`."""
    powers: Floats = np.asarray(chebyshev.cheb2poly(np.eye(size)[order]), np.float64)
    return np.pad(powers, (0, size - len(powers)))
