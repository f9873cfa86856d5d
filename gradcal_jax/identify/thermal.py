"""Removal of the bias over temperature from a record at rest, so that instability remains; with an optional lag.

A sensor in a chamber on a ramp is warmed through its case: the temperature of its bias is a first-order lag behind the
measured one,

    dy/dt = (T - y)/λ,      bias = B(y),      B a polynomial in z = (y - centre)/scale

Heating and cooling then differ by about `2 λ dT/dt · B'`, which no function of the measured temperature can model, and
a term in dT/dt only on a constant ramp: at a reversal that term jumps, and the bias does not.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize

from gradcal_jax.formulas import lag_filter
from gradcal_jax.tables.display import summary


@dataclass(frozen=True)
class ThermalBias:
    """B(T) with its lag, as fitted by `fit_thermal_bias`."""

    coefficients: Float[np.ndarray, " powers"]
    """Coefficients of the powers of z, from power 0 on, in the unit of the rates."""
    centre_c: float
    scale_k: float
    lag_time_s: float
    """Lag λ; zero: the bias follows the measured temperature without lag."""
    residual_rms: float
    """Root mean square of the residuals of the fit, in the unit of the rates."""

    __repr__ = summary

    def bias(
        self, temperature_c: Float[np.ndarray, " samples"], sample_interval_s: float
    ) -> Float[np.ndarray, " samples"]:
        """The bias along a record of measured temperatures (all finite), in the unit of the rates.

        The record is assumed to begin in equilibrium, which makes the lag uncertain for some λ.
        """
        z = (lagged(temperature_c, sample_interval_s, self.lag_time_s) - self.centre_c) / self.scale_k
        return np.polynomial.polynomial.polyval(z, self.coefficients)


def lagged(
    temperature_c: Float[np.ndarray, " samples"], sample_interval_s: float, lag_time_s: float
) -> Float[np.ndarray, " samples"]:
    """A first-order lag behind temperatures that are linear between samples, in equilibrium at the first."""
    if lag_time_s <= 0:
        return temperature_c
    # Imported where it is used: it imports all of SciPy's statistics.
    from scipy.signal import lfilter

    start = temperature_c[0]
    above, _ = lfilter(*lag_filter(sample_interval_s, lag_time_s), temperature_c - start, zi=np.zeros(1))
    return above + start


def fit_thermal_bias(
    rate: Float[np.ndarray, " samples"],
    temperature_c: Float[np.ndarray, " samples"],
    sample_interval_s: float,
    *,
    degree: int = 3,
    lag_time_s: float | None = None,
    longest_lag_s: float = 1800.0,
    valid: Bool[np.ndarray, " samples"] | None = None,
) -> ThermalBias:
    """The polynomial in (lagged) temperature that fits rates at rest best, in the least-squares sense.

    `rate` `(samples,)` in rad/s, every `sample_interval_s` s, with `temperature_c` `(samples,)`; `degree` of B(T).
    `lag_time_s=None` also estimates the lag, between zero and `longest_lag_s` (at that end the record does not
    determine it, and it may be drift); a number fixes it. Rows that are not `valid` are not fitted; temperatures
    missing there (NaN) are interpolated linearly.

    **Raises:** `ValueError` where the rows do not determine the polynomial, or the lag is negative.
    """
    usable = np.ones(len(rate), bool) if valid is None else valid
    if usable.shape != rate.shape or temperature_c.shape != rate.shape:
        raise ValueError("rates, temperatures and the mask must have one value for each sample")
    if degree < 0:
        raise ValueError(f"the degree of the polynomial must be zero or more, not {degree}")
    if lag_time_s is not None and not 0 <= lag_time_s < np.inf:
        raise ValueError(f"the lag must be zero or more, not {lag_time_s} s")
    known = np.isfinite(temperature_c)
    if not known[usable].all() or not np.isfinite(rate[usable]).all():
        raise ValueError("a row that is marked as usable has no rate or no temperature: mark such rows as unusable")
    if len(np.unique(temperature_c[usable])) <= degree:
        raise ValueError(f"a polynomial of degree {degree} needs more than {degree} different temperatures")
    rows = np.arange(len(rate))
    whole = np.interp(rows, rows[known], temperature_c[known])
    low, high = float(whole[usable].min()), float(whole[usable].max())
    centre, scale = (low + high) / 2, max((high - low) / 2, 1e-9)

    def solve(lag: float) -> tuple[Float[np.ndarray, " powers"], float]:
        z = (lagged(whole, sample_interval_s, lag)[usable] - centre) / scale
        # Legendre polynomials for the conditioning of the fit; powers in the result.
        design = np.polynomial.legendre.legvander(z, degree)
        solution, *_ = np.linalg.lstsq(design, rate[usable])
        left = rate[usable] - design @ solution
        return np.polynomial.legendre.leg2poly(solution), float(np.sqrt(np.mean(left**2)))

    if lag_time_s is None:
        # The RMS has one minimum in practice, but a flat one towards long lags: a grid first, then a refinement.
        grid = np.append(0.0, np.geomspace(sample_interval_s, longest_lag_s, 40))
        best = int(np.argmin([solve(float(lag))[1] for lag in grid]))
        optimum: Any = optimize.minimize_scalar(
            lambda lag: solve(float(lag))[1],
            bounds=(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]),
            method="bounded",
        )
        lag_time_s = float(optimum.x) if optimum.fun < solve(float(grid[best]))[1] else float(grid[best])
    coefficients, rms = solve(lag_time_s)
    return ThermalBias(np.atleast_1d(coefficients), centre, scale, lag_time_s, rms)
