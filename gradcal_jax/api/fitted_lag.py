"""The lag of the maps behind the measured temperature, fitted to the data."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

LONGEST_LAG_S = 1800.0


class Lag(NamedTuple):
    """The lag of the maps, s; `std`: its standard deviation where it was fitted."""

    seconds: float
    std: float | None = None

    @property
    def doubts(self) -> list[str]:
        """What speaks against a fitted lag, in sentences."""
        if self.std is None:
            return []
        said: list[str] = []
        if self.seconds > 0.99 * LONGEST_LAG_S:
            said.append(f"the lag is at the longest allowed, {self.seconds:.0f} s: the data do not determine it")
        if self.seconds < 2.0 * self.std:
            said.append(
                f"no lag of the maps shows: the estimate is {self.seconds:.2g} s, its uncertainty (1σ) {self.std:.2g} s"
            )
        return said

    @property
    def sentences(self) -> list[str]:
        """What is said of a fitted lag."""
        if self.std is None or self.doubts:
            return self.doubts
        return [f"the maps follow the temperature {self.seconds:.4g} s late (1σ {self.std:.2g} s)"]


def fitted_lag(chi_squared: Callable[[float], float], degrees: int | None = None) -> Lag:
    """The lag (s) of least χ², and its standard deviation from the curvature of χ². With `degrees` of freedom that is
    widened where the fit with that lag does not hold, by the root of χ² for each of them."""
    known: dict[float, float] = {}

    def value(lag: float) -> float:
        if lag not in known:
            known[lag] = chi_squared(lag)
        return known[lag]

    grid = [0.0, *np.geomspace(5.0, LONGEST_LAG_S, 12).tolist()]
    values = [value(lag) for lag in grid]
    best = int(np.argmin(values))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    minimum: Any = optimize.minimize_scalar(value, bounds=(low, high), method="bounded", options={"xatol": 0.01})
    lag = float(minimum.x) if minimum.fun < values[best] else grid[best]
    # Three different lags, also where the minimum is at zero.
    width = max(0.05 * lag, 1.0)
    around = max(lag - width, 0.0) + width * np.arange(3.0)
    bend = np.polyfit(around, [value(x) for x in around], 2)[0]
    misfit = max(value(lag) / degrees, 1.0) if degrees else 1.0
    return Lag(lag, float(np.sqrt(misfit / bend)) if bend > 0.0 else float("inf"))
