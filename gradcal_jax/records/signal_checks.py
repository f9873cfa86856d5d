"""Rows that a channel shows by itself to be no measurement: values that repeat, outliers, gaps.

A channel is rounded to steps q. If its noise σ is larger than q, equal values in succession are rare, and

    a run of equal values far longer than usual    the channel is frozen
    runs at the largest or smallest value          it is saturated
    runs nearly everywhere                         q > σ: coarse steps; a mean is wrong by up to q/π·exp(−2π²σ²/q²), or
                                                   q/2 without noise (Widrow and Kollár, Quantization Noise, 2008, 4)

Where steps are coarse nothing else is looked for: they are the fault. A row far from the median of its neighbours is an
outlier.
"""

import importlib
import itertools
from collections.abc import Container
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.records.log import Bools, Flags, Floats, Log, LogError, Reason, Whole, without_masked

FAR: Final = 10.0
"""Standard deviations from the neighbours' median beyond which a row is an outlier."""
# Runs: rows of a frozen value and of one at a limit, rows at a limit in all, times the usual length, seconds of a
# frozen temperature.
_FROZEN, _HELD, _AT_LIMIT, _UNUSUAL, _FROZEN_S = 60, 3, 10, 10.0, 30.0
# Outliers: rows of the median, of the local noise, at the ends of a standstill that still settle, about an outlier in
# which more than a pair is a bump; and the largest share.
_BESIDE, _LOCAL, _SETTLING, _CROWD, _PAIR, _RARE = 5, 200, 25, 21, 2, 0.01
# Below this rate (Hz) a single row may be the motion itself.
_LEAST_RATE: Final = 20.0
# A gap is longer than these seconds and intervals: over less, a rate is interpolated.
_GAP_S, _GAP_ROWS = 0.25, 4.0
# K between rows that no thermometer jumps, and the largest share of rows between such jumps.
_JUMP_K, _JUMPED = 5.0, 0.2
# Rows of a window at rest; the share of a step from which rounding counts.
_WINDOW, _OFF = 64, 0.02
# Kurtosis below which values are unlike noise: that of a uniform distribution is 1.8, of noise 3.
_FLAT: Final = 2.2
_SHOWN: Final = {"gyro": ("deg/s", np.pi / 180.0), "accelerometer": ("g", 9.80665)}


def _runs(values: Floats) -> tuple[Whole, Floats]:
    """Equal values in succession: the length and the value of each run."""
    begin = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    return np.diff(begin, append=len(values)), values[begin]


class StepSizes(NamedTuple):
    """The least step of a channel, and by how much rounding to it may bias a mean (0: the steps are fine)."""

    step: float
    off: float


class SignalFaults(NamedTuple):
    """What one unit's samples show: by row `(n,)` the reasons for which it is masked; sentences on them; and by name
    those on coarse steps, which no choice of rows mends."""

    status: Flags
    sentences: list[str]
    coarse: dict[str, str]


def quiet_windows(values: Floats) -> Floats:
    """The rows of a channel at rest `(windows, rows)`: the quieter half of all windows of its finite rows."""
    known = values[np.isfinite(values)]
    windows = known[: len(known) // _WINDOW * _WINDOW].reshape(-1, _WINDOW)
    variance = windows.var(axis=1)
    return windows[variance <= np.median(variance)] if len(windows) else windows


def coarse_steps(values: Floats) -> StepSizes:
    """The steps of a channel `(n,)`, in its unit."""
    some = values[np.isfinite(values)][: 1 << 17]
    distinct = np.unique(some)
    if len(distinct) < 2 or len(some) < 2 * _WINDOW:
        return StepSizes(0.0, 0.0)
    steps = np.diff(distinct)
    step = float(np.min(steps[steps > 1e-9 * float(np.ptp(some))]))
    place = (distinct - distinct[0]) / step
    if float(np.max(np.abs(place - np.rint(place)))) > 0.05:  # no grid: a simulation without rounding
        return StepSizes(0.0, 0.0)
    quiet = quiet_windows(some)
    changes = np.abs(np.diff(quiet, axis=1))
    moved = changes[changes > 0.5 * step]
    # (A sample that is read several times repeats too, and then changes by many steps.)
    if len(moved) > 0.7 * changes.size or (len(moved) and float(np.median(moved)) > 1.5 * step):
        return StepSizes(step, 0.0)
    # (Two values alone are of a channel without noise, between two steps.)
    two = len(np.unique(quiet)) <= 2
    variance = 0.0 if two else max(float(np.median(quiet.var(axis=1))) - step**2 / 12.0, 0.0)
    off = min(0.5, float(np.exp(-2.0 * np.pi**2 * variance / step**2)) / np.pi) if variance > 0.0 else 0.5
    return StepSizes(step, off * step if off > _OFF else 0.0)


def at_a_limit(values: Floats) -> Bools:
    """`(n,)`: rows at the largest or smallest value of a channel of fine steps, where it is held again and again."""
    known = values[np.isfinite(values)]
    if not len(known) or coarse_steps(values).off > 0.0:
        return np.zeros(len(values), bool)
    length, value = _runs(values)
    middle = np.median(known)
    spread = np.median(np.abs(known - middle))
    at = np.zeros(len(value), bool)
    for extreme in (known.max(), known.min()):
        there = value == extreme
        held = np.count_nonzero(there & (length >= _HELD))
        far = abs(extreme - middle) > 20.0 * spread > 0.0
        # (One long run alone is frozen.)
        if held and (far or (held > 1 and length[there].sum() >= _AT_LIMIT)):
            at |= there
    return np.repeat(at, length)


def standing_still(values: Floats) -> Bools:
    """`(n,)`: rows of a channel of fine steps that keep one value for far longer than is usual in it."""
    length, value = _runs(values)
    if len(values) < 2 * _FROZEN or len(length) < 2 or coarse_steps(values).off > 0.0:
        return np.zeros(len(values), bool)
    long = length > max(float(_FROZEN), _UNUSUAL * float(np.quantile(length, 0.9)))
    return np.repeat(long & np.isfinite(value), length)


def outliers(values: Floats, standing: Whole | None) -> Bools:
    """`(n,)`: rare rows farther than `FAR` standard deviations of the noise about them from the median of their
    neighbours, single or in pairs: what lasts longer, the sensor did feel. None if they are not rare.

    `standing` `(n,)`: numbers of standstills, within which alone they are then looked for; None: not known; they must
    then be far beyond the steps from row to row, too, which may be those of a motion by hand.
    """
    ndimage: Any = importlib.import_module("scipy.ndimage")
    result = np.zeros(len(values), bool)
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2 * _LOCAL:
        return result
    own = values[known]
    apart = np.abs(own - ndimage.median_filter(own, _BESIDE, mode="reflect"))
    beyond = apart > FAR * _local_noise(apart, ndimage)
    # (A wrong row moves its neighbours' medians, too, but by less.)
    far = beyond & (apart >= 0.3 * ndimage.maximum_filter1d(apart, _BESIDE))
    if standing is None:
        # (A pair makes three steps, and two single rows four.)
        steps = np.abs(np.diff(own, prepend=own[:1]))
        far &= apart > FAR * ndimage.rank_filter(steps, -5, _CROWD)
    else:
        crowd = ndimage.uniform_filter1d(beyond.astype(float), _CROWD, mode="constant") * _CROWD
        # At the ends of a standstill a table may still settle.
        inside = ndimage.minimum_filter1d((standing >= 0).astype(int), 2 * _SETTLING + 1, mode="constant")
        far &= (crowd < _PAIR + 0.5) & (inside[known] > 0)
    if np.mean(far) < _RARE:
        result[known[far]] = True
    return result


def _local_noise(apart: Floats, ndimage: Any) -> Floats:
    """The standard deviation of the noise about each row, of distances from medians of five; infinite without any."""
    parts = apart[: len(apart) // _LOCAL * _LOCAL].reshape(-1, _LOCAL)
    # In white noise their median is 0.49 σ, and a tenth is beyond 3.27 times that: the median of a block that is partly
    # in motion is that of its rest. A motion that begins in a block is in the next one, too.
    block = np.maximum(np.median(parts, axis=1), np.quantile(parts, 0.9, axis=1) / 3.27) / 0.49
    local = np.repeat(ndimage.maximum_filter1d(block, 3, mode="nearest"), _LOCAL)
    noise = np.append(local, np.full(len(apart) - len(local), local[-1]))
    return np.where(noise > 0.0, noise, np.inf)


def frozen_temperature(time_s: Floats, values: Floats, starts: Whole) -> Bools:
    """`(n,)`: rows whose temperature keeps one value for far longer than is usual and then jumps; all, if it never
    changes. `starts`: rows at which stretches begin, over which it changes by itself."""
    known = np.isfinite(values)
    if not known.any() or np.ptp(values[known]) == 0.0:
        return known & (time_s[-1] - time_s[0] > _FROZEN_S)
    changes = np.diff(values, prepend=np.nan) != 0.0
    changes[starts] = True
    edges = np.append(np.flatnonzero(changes), len(values))
    begin, length = edges[:-1], np.diff(edges)
    finite = known[begin]
    lasting = np.diff(time_s[edges.clip(max=len(time_s) - 1)])
    usual = float(np.median(lasting[finite]))
    jump = np.abs(np.diff(values[begin]))
    step = float(np.median(jump[np.isfinite(jump)])) if np.isfinite(jump).any() else 0.0
    jump[np.isin(begin[1:], starts)] = 0.0
    # Behind the last run nothing is: only a thermometer of fine steps, most of whose runs are short, must have moved
    # on.
    before = lasting[:-1]
    short = before <= _UNUSUAL * usual
    fine = usual < 5.0 * float(np.median(np.diff(time_s))) and before[short].sum() > 0.5 * before.sum()
    after = np.append(jump, np.inf if fine else 0.0)
    return np.repeat(finite & (lasting > max(_FROZEN_S, _UNUSUAL * usual)) & (after > 4.0 * step), length)


def jumped_temperature(values: Floats, starts: Whole) -> Bools:
    """`(n,)`: rows between jumps of the temperature (°C), of which most rows know nothing: 85 °C of a thermometer that
    restarts, 0 of a lost contact; none if they are many. `starts`: rows at which stretches begin."""
    result = np.zeros(len(values), bool)
    known = np.flatnonzero(np.isfinite(values))
    own = values[known]
    jumps = np.abs(np.diff(own)) > _JUMP_K
    if not jumps.any():
        return result
    anew = np.isin(known, starts)
    pieces = np.split(np.arange(len(own)), np.flatnonzero(jumps | anew[1:]) + 1)
    longest = int(np.argmax([len(piece) for piece in pieces]))
    # From the longest piece on, forward and back, a piece that begins near where the last good one ended is good.
    for order, near, far in ((pieces[longest:], 0, -1), (pieces[longest::-1], -1, 0)):
        good = own[order[0][far]]
        for before, piece in itertools.pairwise(order):
            if anew[max(piece[0], before[0])] or abs(own[piece[near]] - good) <= _JUMP_K:
                good = own[piece[far]]
            else:
                result[known[piece]] = True
    return result & (np.mean(result) < _JUMPED)


def refuse_unlike_noise(where: str, values: Floats) -> list[str]:
    """Raise `LogError` where a channel at rest `(n,)` is not noise: one of its values is far more frequent than others
    (a dead band, a limit, a number for missing readings), its steps are coarse, or its sign is missing. Or sentences
    where steps add to its noise, or values are unlike it."""
    finite = values[np.isfinite(values)]
    if len(finite) <= _WINDOW:
        return []
    middle = np.median(finite)
    far = np.abs(finite - middle) > FAR * 1.4826 * np.median(np.abs(finite - middle))
    known = finite[~(standing_still(finite) | (at_a_limit(finite) & far))]
    distinct, counts = np.unique(known, return_counts=True)
    most = int(np.argmax(counts))
    share = counts[most] / len(known)
    if share > 0.5 or (share > _RARE and counts[most] > 10.0 * np.quantile(counts, 0.9)):
        raise LogError(
            f"{where}: {100.0 * share:.2g} % of its rows at rest have the same value ({distinct[most]:.6g}, SI), and "
            "few other values are as frequent: is it a dead band, a limit that cuts off the noise, steps that are "
            "coarse compared with it, or does this value mark missing readings? Log more digits, without a limit or "
            "dead band, and leave missing cells empty"
        )
    if coarse_steps(known).off > 0.0:
        raise LogError(
            f"{where}: its steps are coarse compared with its noise, so the record does not show the noise; log more "
            "digits, or use a smaller full scale"
        )
    if len(known) > 10 * _WINDOW and distinct[0] * distinct[-1] >= 0.0 and _reaches_zero(np.abs(known)):
        raise LogError(
            f"{where}: no row at rest is beyond zero, and many are close to zero: is the sign missing, or is the "
            "value a magnitude? Log the signed rates"
        )
    said = list[str]()
    if (ratio := _steps_over_noise(known)) > 0.5:
        said.append(f"{where}: its steps are {ratio:.2g} times its noise, and increase the measured noise")
    if (flatness := _kurtosis(known)) < _FLAT:
        said.append(
            f"{where}: its values at rest are not like noise (kurtosis {flatness:.2g}; of noise 3): do rows of several "
            "sensors alternate (select one with the key `where`), or does something vibrate?"
        )
    return said


def _reaches_zero(size: Floats) -> bool:
    """Whether many of the sizes of a channel are near zero, though it changes by more from row to row."""
    middle = 0.25 * float(np.median(size))
    return bool(np.mean(size < middle) > 0.05 and np.median(np.abs(np.diff(size))) > middle)


def _kurtosis(known: Floats) -> float:
    """The kurtosis within the quiet windows of a channel."""
    quiet = quiet_windows(known)
    spread = quiet.std(axis=1, keepdims=True)
    z: Floats = (quiet - quiet.mean(axis=1, keepdims=True)) / np.where(spread > 0.0, spread, np.nan)
    return float(np.nanmean(z**4)) if np.isfinite(z).any() else 3.0


def _steps_over_noise(known: Floats) -> float:
    """Steps over the noise, in the whole or a quarter of a record: the resolution may change in its course."""
    for part in (known, *np.array_split(known, 4)):
        quiet = quiet_windows(part)
        spread = float(np.sqrt(np.median(quiet.var(axis=1)))) if len(quiet) else 0.0
        step = coarse_steps(part).step
        if step > 0.5 * spread > 0.0 and len(np.unique(part)) < len(part) // 4:
            return step / spread
    return 0.0


def _faults_of(log: Log, number: int, channels: Container[str] | None, at_rest: bool) -> SignalFaults:
    """What the samples of a unit show by themselves, of rows that are not masked."""
    usable = log.usable(number)
    found = SignalFaults(np.zeros(len(usable), np.uint16), [], {})
    slow = log.standstill is None and log.sample_interval_s * _LEAST_RATE > 1.0

    def mask(reason: Reason, rows: Bools, words: str) -> None:
        if rows.any():
            found.status[rows] |= reason.value
            first, last = formulas.runs(rows)[0].tolist()
            found.sentences.append(
                f"{words}: {np.count_nonzero(rows)} rows are left out, the first from {log.time_s[first]:.6g} to "
                f"{log.time_s[last - 1]:.6g} s"
            )

    for where, values in log.channels(number).items():
        if channels is not None and where not in channels:
            continue
        shown, size = _SHOWN[where.split()[0]]
        own = np.where(usable, values, np.nan)
        if (steps := coarse_steps(own)).off:
            found.coarse[f"coarse steps of {where}"] = (
                f"{where}: its steps of {steps.step / size:.3g} {shown} are coarse compared with its noise: quantised "
                f"values may be wrong by {steps.off / size:.2g} {shown}, however long they are averaged; log more "
                "digits, or use a smaller full scale"
            )
        limit = at_a_limit(own)
        largest = float(np.max(np.abs(own[limit]), initial=0.0)) / size
        words = f"{where} is saturated, at {largest:.4g} {shown} (with all of the moves and standstills concerned)"
        mask(Reason.SATURATED, _whole_segments(log.standstill, limit), words)
        still = standing_still(own) & ~limit
        mask(Reason.FROZEN_VALUES, still, f"frozen: {where} (the value is constant, but not in the rest of the record)")
        own[limit | still] = np.nan
        if at_rest and log.standstill is not None:
            own[log.standstill < 0] = np.nan
        if at_rest or not slow:
            words = f"rows of {where} differ from their neighbours by more than {FAR:g} standard deviations"
            mask(Reason.FAR_FROM_NEIGHBOURS, outliers(own, log.standstill), words)
    if log.temperature_c is not None:
        unknown = frozen_temperature(log.time_s, log.temperature_c[number], log.stretch_starts) & usable
        # (A constant temperature is judged elsewhere.)
        if not unknown[usable].all():
            mask(Reason.FROZEN_TEMPERATURE, unknown, "frozen: the thermometer")
    return found


def without_faults(
    log: Log, channels: Container[str] | None = None, *, at_rest: bool = False
) -> tuple[Log, dict[str, SignalFaults]]:
    """The log without rows that its `channels` ("gyro x"; None: all) show to be no measurement, with stretches that
    begin behind gaps, and by unit what was found. `at_rest`: of a record in which everything that is not marked as
    moving stands still."""
    interval = np.diff(log.time_s)
    usual = float(np.median(interval))
    long = np.flatnonzero(interval > max(_GAP_S, _GAP_ROWS * usual)) + 1
    gaps = np.setdiff1d(long, log.stretch_starts)
    sentences = list[str]()
    if len(gaps):
        log = replace(log, stretch_starts=np.union1d(log.stretch_starts, gaps))
        missing = interval[gaps - 1]
        sentences.append(
            f"gaps: {len(gaps)} without a mark, with about {np.sum(missing / usual - 1.0):.0f} samples lost, the "
            f"longest {missing.max():.3g} s, the first at {log.time_s[gaps[0] - 1]:.6g} s; moves during the gaps are "
            "left out"
        )
    found = {name: _faults_of(log, number, channels, at_rest) for number, name in enumerate(log.units)}
    status = np.stack([one.status for one in found.values()])
    for faults in found.values():
        faults.sentences[:0] = sentences
    if log.status is not None:
        status |= log.status
    return without_masked(replace(log, status=status)) if status.any() else log, found


def _whole_segments(standstill: Whole | None, rows: Bools) -> Bools:
    """The rows of all standstills and moves with such rows: noise that is cut off on one side shifts a mean."""
    if standstill is None or not rows.any():
        return rows
    number = np.cumsum(np.diff(standstill, prepend=standstill[0]) != 0)
    return np.isin(number, np.unique(number[rows]))
