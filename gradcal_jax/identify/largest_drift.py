"""Data of the Direct Bound: the largest drift after an average, over every start in a record.

Source: Z. Berman, "Inertial Sensors - A New Approach for Low Cost Calibration and Testing", section 3, eqs. 6-8.

    θ_i            running angle, the sum of the first i rates (in samples; a constant rate has no effect)
    q_i            [θ_i - θ_(i-m)]/m, mean rate over the Δ = m samples before the start i
    D_k(i)         [θ_(i+k) - θ_i]/k - q_i, drift over the next t = k samples against that mean
    D_θ*(t)        max_i |D_k(i)|, over every start whose two windows are whole

The direct computation makes four passes over the record for every t. Here the starts are divided into blocks of
`_BLOCK`: the extremes of θ and q in each block, computed once, bound D_k in the block,

    k D_k(i) ≤ max θ_(i+k) - [min θ_i + k min q_i]     over the block, and likewise from below,

and only blocks whose bound exceeds the largest value so far are evaluated sample by sample. The result is exact (the
bound is never below the value, including rounding); the work for each t falls from n to about n/30, and for records
with many equal values it is that of the direct computation, in cache. Working memory: two arrays of the length of one
channel.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax import formulas

Blocks = Float[np.ndarray, " blocks"]
Times = Float[np.ndarray, " times"]
_BLOCK = 64
_BLOCKS_AT_ONCE = 1024


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
        stretch = _Stretch.of(rate[start:stop], before, first_sample=start)
        for row, length in enumerate(lengths[:fitting].tolist()):
            value, index = stretch.largest(length, at_least=float(drift[row]))
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


@dataclass(frozen=True)
class _Stretch:
    """One unbroken stretch: θ and q from the first whole average on, and their extremes block by block."""

    angle: Float[np.ndarray, " starts"]
    before: Float[np.ndarray, " starts"]
    angle_low: Blocks
    angle_high: Blocks
    before_low: Blocks
    before_high: Blocks
    pair_low: Blocks
    pair_high: Blocks
    rounding: float
    """Bound on the rounding error of θ + k q, for k = 1; grows with k."""

    @classmethod
    def of(cls, rate: Float[np.ndarray, " samples"], before: int, *, first_sample: int) -> "_Stretch":
        running = running_angle(rate, first_sample=first_sample)
        mean_before = running[before:] - running[:-before]
        mean_before /= before
        angle = running[before:]
        edges = np.arange(0, len(angle), _BLOCK)
        angle_low, angle_high = np.minimum.reduceat(angle, edges), np.maximum.reduceat(angle, edges)
        before_low, before_high = np.minimum.reduceat(mean_before, edges), np.maximum.reduceat(mean_before, edges)
        # A block shifted by k samples overlaps two blocks of the fixed grid.
        pair_low, pair_high = angle_low.copy(), angle_high.copy()
        np.minimum(angle_low[:-1], angle_low[1:], out=pair_low[:-1])
        np.maximum(angle_high[:-1], angle_high[1:], out=pair_high[:-1])
        size = max(-float(angle_low.min()), float(angle_high.max()), -float(before_low.min()), float(before_high.max()))
        rounding = 8.0 * float(np.finfo(np.float64).eps) * size
        return cls(angle, mean_before, angle_low, angle_high, before_low, before_high, pair_low, pair_high, rounding)

    def largest(self, length: int, *, at_least: float) -> tuple[float, int]:
        """(max_i |D_k(i)|, i) for k = `length` where that is above `at_least`, otherwise `at_least` and any i."""
        starts = len(self.angle) - length
        blocks = starts // _BLOCK
        ahead, anchor, mean = self.angle[length:], self.angle[:starts], self.before[:starts]
        tail = blocks * _BLOCK
        best, best_index = at_least * length, 0
        if tail < starts:
            rest = np.abs(ahead[tail:] - (anchor[tail:] + length * mean[tail:]))
            index = int(np.argmax(rest))
            if rest[index] > best:
                best, best_index = float(rest[index]), tail + index
        if blocks == 0:
            return best / length, best_index

        shift = length // _BLOCK
        bound = self.pair_high[shift : shift + blocks] - (self.angle_low[:blocks] + length * self.before_low[:blocks])
        below = self.angle_high[:blocks] + length * self.before_high[:blocks] - self.pair_low[shift : shift + blocks]
        np.maximum(bound, below, out=bound)
        bound += self.rounding * (1 + length)

        # Blocks with the largest bounds first: they raise the level that excludes the others.
        first = min(blocks, 16)
        best, best_index = self._look(length, blocks, np.argpartition(bound, -first)[-first:], best, best_index)
        candidates = np.flatnonzero(bound > best)
        for first in range(0, len(candidates), _BLOCKS_AT_ONCE):
            rows = candidates[first : first + _BLOCKS_AT_ONCE]
            rows = rows[bound[rows] > best]
            if len(rows):
                best, best_index = self._look(length, blocks, rows, best, best_index)
        return best / length, best_index

    def _look(
        self, length: int, blocks: int, rows: Int[np.ndarray, " rows"], best: float, best_index: int
    ) -> tuple[float, int]:
        """The larger of `best` and k |D_k| in some blocks, sample by sample, with its index."""
        whole = blocks * _BLOCK
        values = self.before[:whole].reshape(blocks, _BLOCK)[rows]
        values *= length
        values += self.angle[:whole].reshape(blocks, _BLOCK)[rows]
        np.subtract(self.angle[length : length + whole].reshape(blocks, _BLOCK)[rows], values, out=values)
        np.abs(values, out=values)
        index = int(np.argmax(values))
        value = float(values.flat[index])
        if value <= best:
            return best, best_index
        return value, int(rows[index // _BLOCK]) * _BLOCK + index % _BLOCK


def running_angle(rate: Float[np.ndarray, " samples"], *, first_sample: int) -> Float[np.ndarray, " instants"]:
    """θ, from zero; the mean rate is subtracted first, which changes no drift and keeps θ small."""
    running = np.zeros(len(rate) + 1)
    running[1:] = rate
    mean = running[1:].mean()
    if not np.isfinite(mean):
        bad = int(np.flatnonzero(~np.isfinite(running[1:]))[0]) if not np.isfinite(running).all() else 0
        raise ValueError(f"the rate of sample {first_sample + bad} is not finite: mark such samples as not valid")
    running[1:] -= mean
    return np.cumsum(running, out=running)


def _whole_samples(time_s: float, sample_interval_s: float) -> int:
    if not (0 < sample_interval_s < np.inf and 0 < time_s < np.inf):
        raise ValueError(f"times must be positive: {time_s} s at a sample interval of {sample_interval_s} s")
    count = round(time_s / sample_interval_s)
    if count < 1:
        raise ValueError(f"{time_s} s is shorter than half a sample of {sample_interval_s} s")
    return count
