"""What simulated sensors have in common: consecutive samples by a clock of their own, bases of temperature and rate,
and Gauss–Markov drifts, exactly discretised. NumPy only."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from ... import formulas

_BLOCK = 64

Vectors = NDArray[np.float64]


@dataclass(frozen=True)
class TruthBasis:
    """Functions of a temperature (°C) or a rate (deg/s): "polynomial" (monomials), "legendre", "b-spline" or "bins"."""

    kind: Literal["polynomial", "legendre", "b-spline", "bins"] = "polynomial"
    degree: int = 0
    centre: float = 0.0
    scale: float = 1.0
    knots: tuple[float, ...] = ()

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.kind == "polynomial":
            return formulas.monomials((x - self.centre) / self.scale, self.degree)
        if self.kind == "legendre":
            return legendre.legvander((x - self.centre) / self.scale, self.degree)
        return (
            formulas.b_spline(x, self.knots, self.degree) if self.kind == "b-spline" else formulas.bins(x, self.knots)
        )


@dataclass(frozen=True)
class Process:
    """A Gauss–Markov process of each axis; it adds `bias_gain` times itself to the rate (deg/s) and `rate_gain` times
    itself to the scale factor. An infinite `tau_s` is one draw."""

    sigma: float
    tau_s: float
    bias_gain: float = 0.0
    rate_gain: float = 0.0


class Drifts:
    """Gauss–Markov processes of three axes, advanced from sample to sample."""

    def __init__(self, processes: Sequence[Process], random: np.random.Generator) -> None:
        self._sigmas = np.array([process.sigma for process in processes])
        self._taus_s = np.array([process.tau_s for process in processes])
        self._gains = np.array([(process.bias_gain, process.rate_gain) for process in processes]).reshape(-1, 2)
        self._states = self._sigmas * random.standard_normal((3, len(processes)))
        self._period_s, self._weights = 0.0, np.zeros((0, 0, 0))

    def take(self, draws: Vectors, period_s: float) -> tuple[Vectors, Vectors]:
        """`(n, 3, k)` standard normals -> what the `k` processes add to the output and to the scale factor at the next
        samples, `(n, 3)` each."""
        if not self._sigmas.size:
            return np.zeros(draws.shape[:2]), np.zeros(draws.shape[:2])
        if period_s != self._period_s:
            self._period_s = period_s
            # `(p, block, block + 1)`: x_k = φ^(k + 1) x_0 + Σ_j φ^(k−j) w_j.
            decays, steps = np.exp(-period_s / self._taus_s), np.arange(_BLOCK, dtype=np.int64)
            lag = steps[:, None] - np.append(steps, -1)
            grown = decays[:, None, None] ** np.maximum(lag, 0)
            size = np.append(np.ones(_BLOCK), 0.0) * (self._sigmas * np.sqrt(1.0 - decays**2))[:, None]
            size[:, -1] = 1.0
            self._weights = np.where(lag >= 0, grown, 0.0) * size[:, None, :]
        # In blocks short enough for the little triangular matrices.
        values = np.empty_like(draws)
        for start in range(0, draws.shape[0], _BLOCK):
            kicks = draws[start : start + _BLOCK]
            count = len(kicks)
            known = np.concatenate([kicks, self._states[None]]).transpose(2, 0, 1)
            columns = [*range(count), -1]
            weights = self._weights[:, :count] if count == _BLOCK else self._weights[:, :count, columns]
            values[start : start + count] = (weights @ known).transpose(1, 2, 0)
            self._states = values[start + count - 1]
        return values @ self._gains[:, 0], values @ self._gains[:, 1]


@dataclass(frozen=True)
class SensorSamples:
    """`n` samples: mean rate as measured (deg/s), specific force (g), temperature (°C), true time of their ends, and
    the second thermometer's temperature (None: as the first's)."""

    time_s: NDArray[np.float64]
    rate_dps: NDArray[np.float64]
    acceleration_g: NDArray[np.float64]
    temperature_c: NDArray[np.float64]
    second_c: NDArray[np.float64] | None = None


class SampledSensor(ABC):
    """Consecutive samples by the unit's own clock; the same seed gives the same samples in blocks of any size. A
    subclass gives their values in `take`."""

    clock_error: float
    taken: int
    """Samples since the last restart."""

    def restart(self, now_s: float, sample_rate_hz: float) -> None:
        """Sample at this rate of the unit's clock from now on, which runs fast by the clock error."""
        self._start_s, self.taken = now_s, 0
        self.true_period_s = 1.0 / sample_rate_hz / (1.0 + self.clock_error)

    def next_time_s(self, ahead: int = 1) -> float:
        """True time at which the sample `ahead` from now is complete."""
        return self._start_s + (self.taken + ahead) * self.true_period_s

    def due(self, now_s: float) -> int:
        """The number of complete samples not yet taken."""
        return max(0, int((now_s - self._start_s) / self.true_period_s + 1e-6) - self.taken)

    def ends_of(self, count: int) -> NDArray[np.float64]:
        """`(count + 1,)`: the true times at the ends of the next samples, which count as taken."""
        ends = self._start_s + (self.taken + np.arange(count + 1.0)) * self.true_period_s
        self.taken += count
        return ends

    @abstractmethod
    def take(self, count: int) -> SensorSamples:
        """The next samples."""
