"""Data of the Direct Bound: the largest drift after an average, over every start in a record.

Source: Z. Berman, "Inertial Sensors - A New Approach for Low Cost Calibration and Testing", section 3, eqs. 6-8.

    θ_i            running angle, the sum of the first i rates (in samples; a constant rate has no effect)
    q_i            [θ_i - θ_(i-m)]/m, mean rate over the Δ = m samples before the start i
    D_k(i)         [θ_(i+k) - θ_i]/k - q_i, drift over the next t = k samples against that mean
    D_θ*(t)        max_i |D_k(i)|, over every start whose two windows are whole

Starts are looked at in pieces that stay in the processor's cache: 200 times t of 3.6 million samples take some seconds.
Working memory: two arrays of the length of one channel.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax import formulas

Angles = Float[np.ndarray, " starts"]
Times = Float[np.ndarray, " times"]
_PIECE = 1 << 14


@dataclass(frozen=True)
class LargestDrift:
    """Largest drift D_θ*(t) of a channel; see `largest_drift`."""

    integration_time_s: Times
    """Integration times t, s, increasing; each is a whole number of samples."""
    averaging_time_s: float
    """Averaging time Δ, s; a whole number of samples."""
    largest_drift: Times
    """Largest drift D_θ*(t), in the unit of the rates (rad/s in this package)."""
    start_index: Int[np.ndarray, " times"]
    """First sample of the largest drift, after the average before it."""
    start_count: Int[np.ndarray, " times"]
    """Number of starts over which the largest drift was searched."""
    sample_interval_s: float


def integration_times(shortest_s: float, longest_s: float, sample_interval_s: float, *, count: int = 200) -> Times:
    """At most `count` distinct whole multiples of the sample interval, evenly spread on a logarithmic scale, s."""
    if not 0 < sample_interval_s < np.inf:
        raise ValueError(f"the sample interval must be positive, and this one is {sample_interval_s} s")
    if not 0 < shortest_s <= longest_s < np.inf:
        raise ValueError(f"integration times must be positive and increasing, not {shortest_s} to {longest_s} s")
    if count < 1:
        raise ValueError(f"at least one integration time is needed, and there are {count}")
    wanted = np.geomspace(shortest_s, longest_s, count) if count > 1 else np.array([longest_s])
    return np.unique(np.maximum(np.rint(wanted / sample_interval_s), 1.0)) * sample_interval_s


def longest_integration_time(
    valid: Bool[np.ndarray, " samples"], sample_interval_s: float, averaging_time_s: float
) -> float:
    """The longest t (s) for which an unbroken stretch still has one start; zero or less without one."""
    longest = max((stop - start for start, stop in formulas.runs(valid).tolist()), default=0)
    return (longest - _whole_samples(averaging_time_s, sample_interval_s)) * sample_interval_s


def largest_drift(
    rate: Float[np.ndarray, " samples"],
    sample_interval_s: float,
    integration_times_s: Times,
    averaging_time_s: float,
    *,
    valid: Bool[np.ndarray, "..."] | None = None,
) -> LargestDrift:
    """D_θ*(t) of the paper's eqs. 6-8: the largest drift over all starts, for each integration time.

    **Arguments:** `rate`, evenly sampled at rest, rad/s; `integration_times_s` t and `averaging_time_s` Δ are rounded
    to whole samples, and equal ones merged; `valid` is false for samples that no window may contain. Gaps in time are
    invalid samples on the even grid.

    **Raises:** `ValueError` where an integration time fits no unbroken stretch (it names the longest that does), where
    a usable rate is not finite, or where a time is not positive.

    Memory beside the record itself: 17 bytes a sample.
    """
    usable = np.ones(len(rate), bool) if valid is None else valid
    if usable.shape != rate.shape:
        raise ValueError(
            f"the mask of usable samples has the shape {usable.shape}, and the rates have the shape {rate.shape}"
        )
    before = _whole_samples(averaging_time_s, sample_interval_s)
    lengths = np.unique([_whole_samples(float(time), sample_interval_s) for time in integration_times_s])
    if len(lengths) == 0:
        raise ValueError("at least one integration time is needed")

    drift = np.full(len(lengths), -1.0)  # below any magnitude, so that the first start counts
    start_index, start_count = np.zeros(len(lengths), np.int64), np.zeros(len(lengths), np.int64)
    longest = 0
    for start, stop in formulas.runs(usable).tolist():
        longest = max(longest, stop - start)
        fitting = int(np.searchsorted(lengths, stop - start - before, side="right"))
        if fitting == 0:
            continue
        running = running_angle(rate[start:stop])
        mean_before = (running[before:] - running[:-before]) / before
        for row, length in enumerate(lengths[:fitting].tolist()):
            value, index = _largest(running[before:], mean_before, length)
            start_count[row] += stop - start - before - length + 1
            if value > drift[row]:
                drift[row], start_index[row] = value, start + before + index
    if start_count[-1] == 0:
        room = (longest - before) * sample_interval_s
        raise ValueError(
            f"an integration of {lengths[-1] * sample_interval_s:g} s after an average of "
            f"{before * sample_interval_s:g} s is longer than every unbroken part of the record (the longest has "
            f"{longest * sample_interval_s:g} s): "
            + (
                f"choose integration times of at most {room:g} s"
                if room > 0
                else "use a shorter averaging time, or a longer record"
            )
        )
    return LargestDrift(
        lengths * sample_interval_s, before * sample_interval_s, drift, start_index, start_count, sample_interval_s
    )


def _largest(angle: Angles, before: Angles, length: int) -> tuple[float, int]:
    """(max_i |D(i)|, i) over `length` samples, of θ `angle` and the mean rate `before` it at every start."""
    best, best_index = -1.0, 0
    starts = len(angle) - length
    for first in range(0, starts, _PIECE):
        last = min(first + _PIECE, starts)
        values = length * before[first:last]
        values += angle[first:last]
        np.subtract(angle[first + length : last + length], values, out=values)
        np.abs(values, out=values)
        index = int(np.argmax(values))
        if values[index] > best:
            best, best_index = float(values[index]), first + index
    return best / length, best_index


def running_angle(rate: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " instants"]:
    """θ, from zero; the mean rate is subtracted first, which changes no drift and keeps θ small."""
    running = np.zeros(len(rate) + 1)
    running[1:] = rate
    mean = running[1:].mean()
    if not np.isfinite(mean):
        raise ValueError("the rate of a sample is not finite: mark such samples as not valid")
    running[1:] -= mean
    return np.cumsum(running, out=running)


def _whole_samples(time_s: float, sample_interval_s: float) -> int:
    if not (0 < sample_interval_s < np.inf and 0 < time_s < np.inf):
        raise ValueError(f"times must be positive: {time_s} s at a sample interval of {sample_interval_s} s")
    count = round(time_s / sample_interval_s)
    if count < 1:
        raise ValueError(f"{time_s} s is shorter than half a sample of {sample_interval_s} s")
    return count
