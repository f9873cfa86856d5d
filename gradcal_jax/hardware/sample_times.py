"""The own time of a unit's samples, by a counter or a time that it sends, and what that shows to be lost.

A counter that wraps early shows losses modulo its modulus, and the log adds the rest by the host's clock; a time or a
long counter shows them all, and that the unit restarted. Without a stamp the rate of samples alone shows a loss.
"""

from typing import Any, Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.hardware.roles import Floats, ImuBatch, imu_batch

_LONG = 1 << 16
SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


class SampleTimes:
    """The unit's own times (s) of its samples, from a stamp of each: `kind` "count", "time", or "" for none.

    tick_s   duration of one step of the stamp, s
    modulus  value at which the stamp restarts at 0; None: it never restarts
    """

    def __init__(self, kind: str, rate_hz: float, tick_s: float, modulus: int | None) -> None:
        self._kind, self._rate_hz, self._modulus = kind, rate_hz, modulus
        self.resolution_s = tick_s if kind else 1.0 / rate_hz
        self._step = 1.0 / (rate_hz * self.resolution_s)
        self._short = kind == "count" and modulus is not None and modulus < _LONG
        self.round_samples = round((modulus or 0) / self._step) if self._short else 0
        self._before: tuple[float, float] | None = None
        self._samples = 0

    def push(self, stamps: Any) -> tuple[Any, Any, Any]:
        """For each sample: its time, the samples missing before it, and whether the unit restarted before it."""
        count = len(stamps)
        never = np.zeros(count, np.bool_)
        if not self._kind:
            first, self._samples = self._samples, self._samples + count
            return np.arange(first + 1, first + 1 + count) / self._rate_hz, np.zeros(count, np.int64), never
        stamps = stamps.astype(np.float64)
        stamp, ticks = self._before or (float(stamps[0]) - self._step, 0.0)
        steps = np.diff(stamps, prepend=stamp)
        restarted = steps < 0.0
        if self._modulus is not None:
            steps = np.mod(steps, float(self._modulus))
            restarted = never if self._short else steps > 0.5 * self._modulus
        steps = np.where(restarted, self._step, steps)
        if self._short:
            steps[steps == 0.0] = self._modulus
        counts = ticks + np.cumsum(steps)
        self._before = float(stamps[-1]), float(counts[-1])
        gaps = np.maximum(np.rint(steps / self._step).astype(np.int64) - 1, 0)
        return counts * self.resolution_s, gaps, restarted


def conversion(unit: str, wanted: str, factor: float = 1.0) -> tuple[float, float]:
    """Scale and zero of a linear change of units, times `factor`."""
    zero = units.convert(0.0, unit, wanted) * factor
    return units.convert(1.0, unit, wanted) * factor - zero, zero


class SampleDecoder:
    """The part of every decoder behind its codec: samples of the numbers that came together.

    rate_hz  samples per second; for the others see `SampleTimes`
    """

    def __init__(self, kind: str, rate_hz: float, tick_s: float, modulus: int | None) -> None:
        self._times = SampleTimes(kind, rate_hz, tick_s, modulus)
        self.sample_s, self.resolution_s = 1.0 / rate_hz, self._times.resolution_s
        self.round_samples = self._times.round_samples
        self.bad_bytes = self.repeated_datagrams = 0
        self._disturbed = False

    def _noise(self, count: int) -> None:
        """So many bytes belong to no sample."""
        self.bad_bytes += count
        self._disturbed = self._disturbed or count > 0

    def _batch(
        self, host_time_s: float, stamps: Floats, values: dict[str, Floats], disturbed: Any, **more: Any
    ) -> ImuBatch:
        """`stamps` `(n,)`; `values` `(n, 3)` by quantity, of what the unit sends; `disturbed` `(n,)`."""
        times, gaps, restarted = self._times.push(stamps)
        absent = np.full((len(stamps), 3), np.nan)
        more["restarted"] = restarted | more.get("restarted", False)
        return imu_batch(
            host_time_s,
            times,
            *(values.get(name, absent) for name in ("gyro", "acceleration", "temperature")),
            second_c=values.get("second_temperature", absent).mean(axis=1),
            gap_before=gaps,
            disturbed=disturbed & bool(self.round_samples),
            **more,
        )
