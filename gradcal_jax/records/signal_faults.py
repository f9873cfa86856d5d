"""Faults that the samples of one channel show by themselves: values at a limit, values that stand still, coarse steps.

A channel with fine steps hardly ever repeats a value: its noise is larger than the step. So many values alike on end
are no chance, and neither are many at the channel's own extreme. Where the steps are *coarse*, larger than the noise,
values repeat by nature: then neither is looked for, and the steps are the fault. A value x between two steps q apart,
with noise σ, is rounded to a mean that is off by up to q/π·exp(−2π²σ²/q²), q/2 without noise, however long it is
averaged (Widrow and Kollár, Quantization Noise, 2008, section 4).
"""

import importlib
import itertools
from collections.abc import Container
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.records.log import Bools, Floats, Log, LogError, Reason, Whole, without_masked

# Values alike on end: of a sample that stands still, of one at a limit; and the least number of the latter in all.
_FROZEN, _STUCK, _AT_A_LIMIT = 60, 3, 10
# Times the usual repetition of a channel whose samples are read more often than they are made.
_UNUSUAL: Final = 10.0
# A coarse channel changes in less than this share of its rows at rest, by no more than these steps.
_REPEATED, _FEW_STEPS = 0.7, 1.5
# Share of a step by which rounding may be off before that is said.
_OFF: Final = 0.02
# Rows of which the least step is found, and of a window in which the noise is.
_LOOKED_AT, _WINDOW = 1 << 17, 64
_FROZEN_S: Final = 30.0
# K from row to row that no thermometer jumps, and the largest share of rows between such jumps.
_JUMP_K, _JUMPED = 5.0, 0.2
FAR: Final = 10.0
"""A row that differs from its neighbours by more standard deviations than this is wrong."""
# Rows around one with which it is compared at rest, and in motion; the largest share of wrong ones.
_AROUND, _BESIDE, _RARE = 51, 5, 0.01
# Rows of which the noise is taken in motion; rows at the ends of a standstill in which a table may still settle; least
# rate (Hz) at which a single row is not the motion itself; median distance of white noise from its medians of five.
_OF_FIVE = 0.49
_NOISE_OF, _SETTLING, _LEAST_RATE = 200, 25, 20.0
# Of deviations from the median of five, in white noise: what a tenth of them exceeds, over their median.
_TENTH_OVER_MEDIAN: Final = 3.27
# Rows about a glitch in which more than a pair of such rows are no glitch.
_CROWD, _PAIR = 21, 2
# Steps of more than this share of the noise add 2 % to its variance.
_ADDS: Final = 0.5
# Share of rows of one value, far more frequent than any other.
_ONE_VALUE: Final = 0.02
# Share of values near zero of a magnitude; parts of a record in which steps are looked for.
_AT_ZERO, _PARTS = 0.05, 4
# Rows of which the noise is taken, and the factor by which it may change.
_NOISE_BLOCK, _CHANGES = 500, 1.4
_ROUNDING, _OFF_THE_GRID = 1e-9, 0.05
# A gap lasts longer than this, and than so many intervals: over less, a rate is interpolated.
_GAP_S, _GAP_ROWS = 0.25, 4.0
_NAMES: Final = {"gyro": ("deg/s", np.pi / 180.0), "accelerometer": ("g", 9.80665)}


class StepSizes(NamedTuple):
    """Steps of a channel: the least one, and by how much rounding to it may be off; zero where it is fine."""

    step: float
    off: float


class SignalFaults(NamedTuple):
    """What the samples of a unit show: rows at which stretches begin, those after gaps included; which rows `(n,)` are
    at a limit, in which a value stands still, which are far from their neighbours, and in which the temperature stands
    still; sentences on them, and by its name on coarse steps, which no choice of rows mends."""

    starts: Whole
    saturated: Bools
    frozen: Bools
    far: Bools
    frozen_temperature: Bools
    sentences: tuple[str, ...]
    coarse: dict[str, str]


def quiet_windows(values: Floats) -> Floats:
    """The rows of a channel at rest `(windows, rows)`: the quieter half of all windows of its finite rows."""
    known = values[np.isfinite(values)]
    windows = known[: len(known) // _WINDOW * _WINDOW].reshape(-1, _WINDOW)
    variance = windows.var(axis=1)
    return windows[variance <= np.median(variance)] if len(windows) else windows


def coarse_steps(values: Floats) -> StepSizes:
    """The steps of a channel `(n,)`, in its unit."""
    some = values[np.isfinite(values)][:_LOOKED_AT]
    distinct = np.unique(some)
    if len(distinct) < 2 or len(some) < 2 * _WINDOW:
        return StepSizes(0.0, 0.0)
    steps = np.diff(distinct)
    # (Differences that are rounding are no steps.)
    step = float(np.min(steps[steps > _ROUNDING * float(np.ptp(some))]))
    # (Values of any size, as of a simulation without noise, lie on no grid.)
    place = (distinct - distinct[0]) / step
    if float(np.max(np.abs(place - np.rint(place)))) > _OFF_THE_GRID:
        return StepSizes(0.0, 0.0)
    quiet = quiet_windows(some)
    changes = np.abs(np.diff(quiet, axis=1))
    moved = changes[changes > 0.5 * step]
    # (A sample that is read several times repeats too, and then changes by many steps.)
    if len(moved) > _REPEATED * changes.size or (len(moved) and float(np.median(moved)) > _FEW_STEPS * step):
        return StepSizes(step, 0.0)
    # (Two values alone are of a channel without noise, between two steps.)
    two = len(np.unique(quiet)) <= 2
    noise = 0.0 if two else max(float(np.median(quiet.var(axis=1))) - step**2 / 12.0, 0.0)
    off = min(0.5, float(np.exp(-2.0 * np.pi**2 * noise / step**2)) / np.pi) if noise > 0.0 else 0.5
    return StepSizes(step, off * step if off > _OFF else 0.0)


def refuse_repeated(where: str, values: Floats) -> str | None:
    """Raise `LogError` where a channel at rest repeats values for the coarseness of its steps, or within a dead band,
    or has lost its sign; or a sentence where the steps add to its noise."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    distinct, counts = np.unique(known, return_counts=True)
    most = int(np.argmax(counts))
    if len(known) > _WINDOW and counts[most] > 0.5 * len(known):
        raise LogError(
            f"{where}: {100.0 * counts[most] / len(known):.3g} % of its rows at rest have the same value "
            f"({distinct[most]:.4g}, SI): smaller changes are hidden by a dead band, or by steps that are coarse "
            "compared with the noise; log more digits, without a dead band"
        )
    steps = coarse_steps(known)
    if steps.off > 0.0:
        raise LogError(
            f"{where}: its steps ({steps.step:.4g}, SI) are coarse compared with its noise, so the record does "
            "not show the noise; log more digits, or use a smaller full scale"
        )
    if len(known) > 10 * _WINDOW and distinct[0] * distinct[-1] >= 0.0 and _reaches_zero(np.abs(known)):
        raise LogError(
            f"{where}: no row at rest is {'below' if distinct[-1] > 0.0 else 'above'} zero, and many are close to "
            "zero: is the sign missing, or is the value a magnitude? Log the signed rates"
        )
    middle = float(np.median(known))
    far = np.abs(distinct - middle) > FAR * 1.4826 * float(np.median(np.abs(known - middle)))
    if np.sum(counts[far]) > _RARE * len(known) and (some := int(np.max(counts[far]))) > 0.5 * np.sum(counts[far]):
        raise LogError(
            f"{where}: {100.0 * some / len(known):.2g} % of its rows at rest have the value "
            f"{distinct[far][np.argmax(counts[far])]:.6g} (SI), far from all others: does this value mark "
            "missing readings? Leave such cells empty"
        )
    if counts[most] > _ONE_VALUE * len(known) and counts[most] > _UNUSUAL * np.max(np.delete(counts, most), initial=0):
        return (
            f"{where}: {100.0 * counts[most] / len(known):.2g} % of its rows at rest have the same value "
            f"({distinct[most]:.4g}, SI), and no other value is as frequent: does the sensor have a dead band? A "
            "dead band makes the measured noise too small"
        )
    # (The resolution may change in the course of a record.)
    for part in (known, *np.array_split(known, _PARTS)):
        quiet = quiet_windows(part)
        spread = float(np.sqrt(np.median(quiet.var(axis=1)))) if len(quiet) else 0.0
        step = steps.step if part is known else coarse_steps(part).step
        if step > _ADDS * spread > 0.0 and len(np.unique(part)) < len(part) // 4:
            return f"{where}: its steps are {step / spread:.2g} times its noise, and increase the measured noise"
    return None


def _reaches_zero(size: Floats) -> bool:
    """Whether many of the sizes of a channel are near zero, though it changes by more from row to row."""
    middle = 0.25 * float(np.median(size))
    return bool(np.mean(size < middle) > _AT_ZERO and np.median(np.abs(np.diff(size))) > middle)


def changing_noise(where: str, values: Floats) -> str | None:
    """A sentence where the noise from row to row of a channel at rest changes in the course of the record."""
    known = values[np.isfinite(values)]
    count = min(len(known) // _NOISE_BLOCK, 20)
    if count < 2:
        return None
    blocks = np.stack([np.diff(part[: len(known) // count]).std() for part in np.array_split(known, count)])
    low, high = float(np.quantile(blocks, 0.1)), float(np.quantile(blocks, 0.9))
    if low > 0.0 and high < _CHANGES * low:
        return None
    return (
        f"{where}: the noise changes during the record, by a factor of {high / low if low > 0.0 else np.inf:.2g}; "
        "the result is an average"
    )


def at_a_limit(values: Floats) -> Bools:
    """`(n,)`: rows at the largest or least value of a channel of fine steps, where it is held again and again."""
    result = np.zeros(len(values), bool)
    finite = values[np.isfinite(values)]
    for extreme in () if not len(finite) else (float(finite.max()), float(finite.min())):
        there = values == extreme
        if np.count_nonzero(there) < _STUCK:
            continue
        held = np.count_nonzero(np.ptp(formulas.runs(there), axis=1) >= _STUCK)
        # (One long run alone is a channel that stands still.)
        if held and ((held > 1 and np.count_nonzero(there) >= _AT_A_LIMIT) or _is_far(extreme, finite)):
            result |= there
    return result if not result.any() or coarse_steps(values).off == 0.0 else np.zeros(len(values), bool)


_ACROSS: Final = 1.5
"""A step of so many times the largest value leads from one end of a channel's range to the other."""
_WITHIN: Final = (5, 20, 80)
"""Rows over which a slope is measured on both sides of such a step: fast changes, or small ones in many samples."""


def wrapped(values: Floats) -> Bools:
    """`(n,)`: rows whose value left the range of its format at one end and came in at the other, as integers do.

    They lie between two steps across the range, there and back; on both sides of each the values change against the
    step. A table that reverses its direction within a row does not look so.
    """
    result = np.zeros(len(values), bool)
    step = np.diff(values)
    bends = np.abs(np.diff(step))
    if not np.isfinite(bends).any():
        return result
    far = _ACROSS * float(np.nanmax(np.abs(values)))
    least = 6.0 * float(np.nanmedian(bends))

    across = np.flatnonzero(np.abs(step) > far)
    within = np.where(np.abs(step) > far, 0.0, step)

    def against(out: int, back: int, rows: int) -> bool:
        sides = [(out, within[max(out - rows, 0) : out]), (back, within[back + 1 : back + 1 + rows])]
        if back - out > 2 * rows:  # else too short a time to have slopes
            sides += [(out, within[out + 1 : out + 1 + rows]), (back, within[back - rows : back])]
        return all(-np.sign(step[at]) * float(np.sum(side)) > least for at, side in sides)

    for out, back in itertools.pairwise(across.tolist()):
        if step[out] * step[back] < 0.0 and not result[out] and any(against(out, back, rows) for rows in _WITHIN):
            result[out + 1 : back + 1] = True
    return result


def _is_far(value: float, values: Floats) -> bool:
    middle = float(np.median(values))
    return abs(value - middle) > 20.0 * float(np.median(np.abs(values - middle))) > 0.0


def far_from_neighbours(values: Floats) -> Bools:
    """`(n,)`: rare rows of a channel at rest that are more than `FAR` standard deviations from the median of the rows
    around them; none where they are not rare."""
    result = np.zeros(len(values), bool)
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2 * _WINDOW:
        return result
    own = values[known]
    ndimage: Any = importlib.import_module("scipy.ndimage")
    around: Floats = ndimage.median_filter(own, _AROUND, mode="reflect")
    apart = np.abs(own - around)
    usual = float(np.median(apart))
    far = apart > FAR * 1.4826 * usual
    if usual > 0.0 and np.mean(far) < _RARE:
        result[known[far]] = True
    return result


def glitches(values: Floats, standing: Whole | None, *, by_hand: bool = False) -> Bools:
    """`(n,)`: rare single rows and pairs of a channel, far from the median of the five rows about them: more than `FAR`
    standard deviations of the noise about them, or of all standstills, `standing` `(n,)`, within which they are then
    looked for alone. `by_hand`: also `FAR` times the steps from row to
    row about them, since a bump of a hand lasts for several rows."""
    apart = np.full(len(values), np.nan)
    ndimage: Any = importlib.import_module("scipy.ndimage")
    looked_at = np.isfinite(values)
    if standing is not None:
        inside = np.zeros(len(values), bool)
        for start, stop in formulas.runs(standing >= 0).tolist():
            inside[start + _SETTLING : max(stop - _SETTLING, start + _SETTLING)] = True
        looked_at &= inside
    known = np.flatnonzero(np.isfinite(values))
    result = np.zeros(len(values), bool)
    if len(known) < 2 * _NOISE_OF:
        return result
    own = values[known]
    apart[known] = np.abs(own - ndimage.median_filter(own, _BESIDE, mode="reflect"))
    some = apart[known]
    parts = some[: len(some) // _NOISE_OF * _NOISE_OF].reshape(-1, _NOISE_OF)
    # The median of a block that is partly in motion would be that of its rest.
    blocks = np.maximum(np.median(parts, axis=1), np.quantile(parts, 0.9, axis=1) / _TENTH_OVER_MEDIAN)
    if standing is None:
        # (The block's own noise and its neighbours': a motion that begins within a block is in the next one, too.)
        noise = np.repeat(ndimage.maximum_filter1d(blocks, 3, mode="nearest"), _NOISE_OF)
        noise = np.append(noise, np.full(len(some) - len(noise), noise[-1]))
    else:
        here = looked_at[known]
        noise = np.full(len(some), np.median(some[here]) if here.any() else 0.0)
    # (In motion a wrong row moves its neighbours' medians, too, but by less.)
    worst = some >= 0.3 * ndimage.maximum_filter1d(some, _BESIDE)
    beyond = (some > FAR / _OF_FIVE * noise) & (noise > 0.0)
    far = beyond & worst & looked_at[known]
    if by_hand:
        # (A pair makes three steps, and two single rows four.)
        steps = np.abs(np.diff(own, prepend=own[:1]))
        far &= some > FAR * ndimage.rank_filter(steps, -5, _CROWD)
    else:
        # Several such rows close together are a bump or the begin of a motion, which the sensor did feel.
        crowded = ndimage.uniform_filter1d(beyond.astype(float), _CROWD, mode="constant") * _CROWD > _PAIR + 0.5
        far &= ~crowded
    if np.mean(far) < _RARE:
        result[known[far]] = True
    return result


def standing_still(values: Floats) -> Bools:
    """`(n,)`: rows of a channel of fine steps with one value for far longer than is usual in it."""
    result = np.zeros(len(values), bool)
    if len(values) < 2 * _FROZEN or coarse_steps(values).off > 0.0:
        return result
    begin = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    lengths = np.diff(begin, append=len(values))
    if len(lengths) < 2:
        return result
    for index in np.flatnonzero(lengths > max(float(_FROZEN), _UNUSUAL * float(np.quantile(lengths, 0.9)))):
        result[begin[index] : begin[index] + lengths[index]] = np.isfinite(values[begin[index]])
    return result


def frozen_temperature(time_s: Floats, values: Floats, starts: Whole) -> Bools:
    """`(n,)`: rows whose temperature does not change for far longer than is usual in this record, all if it never
    does; `starts`: rows at which stretches begin."""
    result = np.zeros(len(values), bool)
    known = np.isfinite(values)
    if not known.any():
        return result
    changes = np.ones(len(values), bool)
    changes[1:] = (values[1:] != values[:-1]) & (known[1:] | known[:-1])
    changes[starts] = True
    begin = np.flatnonzero(changes)
    end = np.append(begin[1:], len(values))
    lasting = time_s[np.minimum(end, len(time_s) - 1)] - time_s[begin]
    if np.ptp(values[known]) == 0.0:
        return known if time_s[-1] - time_s[0] > _FROZEN_S else result
    finite = known[begin]
    # A coarse sensor on a slow ramp repeats values too, but evenly; and after a frozen stretch there is a jump.
    usual = float(np.median(lasting[finite]))
    jump = np.abs(np.diff(values[begin]))
    step = float(np.median(jump[np.isfinite(jump)])) if np.isfinite(jump).any() else 0.0
    # (Over a pause temperature changes by itself. After the last stretch nothing is: a plateau within the resolution of
    # a coarse sensor, which most of the time shows one value, is no fault.)
    short = lasting[:-1][lasting[:-1] <= 10.0 * usual]
    fine = usual < 5.0 * float(np.median(np.diff(time_s))) and np.sum(short) > 0.5 * np.sum(lasting[:-1])
    after = np.append(np.where(np.isin(begin[1:], starts), 0.0, jump), np.inf if fine else 0.0)
    long = finite & (lasting > max(_FROZEN_S, 10.0 * usual)) & (after > 4.0 * step)
    for index in np.flatnonzero(long):
        result[begin[index] : end[index]] = True
    return result


def refuse_clipped(where: str, values: Floats) -> None:
    """Raise `LogError` where a limit cuts off the noise of a channel at rest."""
    limit, known = at_a_limit(values), values[np.isfinite(values)]
    share = np.count_nonzero(limit) / max(len(known), 1)
    if share > _RARE:
        middle = float(np.median(known))
        size, noise = np.abs(values[limit] - middle), 1.4826 * float(np.median(np.abs(known - middle)))
        if float(np.max(size)) < FAR * noise:
            raise LogError(
                f"{where}: {100.0 * share:.2g} % of its rows at rest are at a limit, {float(np.min(size)) / noise:.2g} "
                "standard deviations from the median: this limit cuts off the noise, so the record does not show how "
                "large the noise is; use a larger full scale, or the values before limiting"
            )


def jumped_temperature(values: Floats, starts: Whole) -> Bools:
    """`(n,)`: rows between jumps of the temperature (°C), of which most rows know nothing: 85 °C of a thermometer that
    restarts, 0 of a lost contact; none if they are many. `starts`: rows at which stretches begin."""
    result = np.zeros(len(values), bool)
    known = np.flatnonzero(np.isfinite(values))
    cut = np.abs(np.diff(values[known])) > _JUMP_K
    if not cut.any():
        return result
    cuts = np.flatnonzero(cut | np.isin(known[1:], starts)) + 1
    begins, ends = np.concatenate([[0], cuts]), np.concatenate([cuts, [len(known)]])
    pieces = list(zip(begins.tolist(), ends.tolist(), strict=True))
    own, longest = values[known], int(np.argmax(ends - begins))
    # From the longest piece on, forward and back, a piece that begins near where the last good one ended is good.
    for order, last in ((pieces[longest:], 1), (pieces[longest::-1], 0)):
        good = own[order[0][last] - last]
        for piece in order[1:]:
            near, far = piece[1 - last] + last - 1, piece[last] - last
            behind_gap = known[piece[0] if last else piece[1]] in starts
            if behind_gap or abs(own[near] - good) <= _JUMP_K:
                good = own[far]
            else:
                result[known[piece[0] : piece[1]]] = True
    return result if np.mean(result) < _JUMPED else np.zeros(len(values), bool)


def after_gaps(log: Log) -> tuple[Whole, list[str]]:
    """Rows at which a log's stretches begin, gaps that it does not mark included, and a sentence on those."""
    interval = np.diff(log.time_s)
    usual = float(np.median(interval))
    gaps = np.flatnonzero(interval > max(_GAP_S, _GAP_ROWS * usual)) + 1
    new = np.setdiff1d(gaps, log.stretch_starts)
    if not len(new):
        return log.stretch_starts, []
    lost, longest = np.sum(interval[new - 1] / usual - 1.0), float(np.max(interval[new - 1]))
    return np.union1d(log.stretch_starts, new).astype(np.int64), [
        f"{len(new)} gap{'s' if len(new) > 1 else ''} with about {lost:.0f} samples lost, the longest "
        f"{longest:.3g} s, the first at {log.time_s[new[0] - 1]:.6g} s: moves during the gaps are left out"
    ]


def signal_faults(
    log: Log,
    unit: str | int = 0,
    channels: Container[str] | None = None,
    *,
    at_rest: bool = False,
    by_hand: bool = False,
) -> SignalFaults:
    """What the samples of a unit's `channels` ("gyro x"; None: of all) show by themselves, of rows not masked;
    `at_rest`: of a record in which everything that is not marked as moving stands still; `by_hand`: of one that a hand
    turns now and then, whose bumps are no wrong rows."""
    number, usable = log.unit_index(unit), log.usable(unit)
    saturated, frozen, far, unknown = (np.zeros(len(usable), bool) for _ in range(4))
    slow = log.standstill is None and log.sample_interval_s * _LEAST_RATE > 1.0
    still = dict[bytes, tuple[Bools, list[str]]]()
    starts, sentences = after_gaps(log)
    coarse = dict[str, str]()
    triads = (("gyro", log.axes, log.rate_rad_per_s), ("accelerometer", log.force_axes, log.specific_force_m_per_s2))
    for kind, labels, values in triads:
        for k, label in enumerate(labels):
            (name, size), where = _NAMES[kind], f"{kind} {label}"
            if values is None or (channels is not None and where not in channels):
                continue
            own = np.where(usable, values[number, :, k], np.nan)
            steps = coarse_steps(own)
            if steps.off:
                coarse[f"coarse steps of {where}"] = (
                    f"{where}: its steps of {steps.step / size:.3g} {name} are coarse compared with its noise: "
                    f"quantised values may be wrong by {steps.off / size:.2g} {name}, however long they are "
                    "averaged; log more digits, or use a smaller full scale"
                )
            if (limit := at_a_limit(own) | wrapped(own)).any():
                saturated |= limit
                largest = float(np.max(np.abs(own[limit]))) / size
                sentences.append(
                    f"{where} is saturated in {np.count_nonzero(limit)} rows, at {largest:.4g} {name}: the moves and "
                    "standstills with these rows are left out"
                )
            alike = standing_still(own) & ~limit
            if alike.any():
                frozen |= alike
                still.setdefault(alike.tobytes(), (alike, []))[1].append(where)
            own[limit | alike] = np.nan
            if at_rest:
                own = own if log.standstill is None else np.where(log.standstill >= 0, own, np.nan)
                apart = far_from_neighbours(own)
            else:
                unmarked = by_hand and log.standstill is None
                apart = np.zeros(len(own), bool) if slow else glitches(own, log.standstill, by_hand=unmarked)
            if apart.any():
                far |= apart
                count = np.count_nonzero(apart)
                sentences.append(
                    f"{where}: {count} rows ({count / len(own):.2g} of all) differ from their neighbours by more "
                    f"than {FAR:g} standard deviations, and are left out"
                )
    if log.temperature_c is not None:
        values = np.where(np.isfinite(log.temperature_c[number]), log.temperature_c[number], np.nan)
        unknown = frozen_temperature(log.time_s, values, log.stretch_starts) & usable
        if unknown[usable].all():
            unknown[:] = False  # a constant temperature, which others judge
        elif unknown.any():
            still[b""] = (unknown, ["the thermometer"])
    sentences += [_stands_still(", ".join(names), log.time_s, rows) for rows, names in still.values()]
    return SignalFaults(starts, _whole(log, saturated), frozen, far, unknown, tuple(sentences), coarse)


def without_faults(
    log: Log, channels: Container[str] | None = None, *, at_rest: bool = False, by_hand: bool = False
) -> tuple[Log, dict[str, SignalFaults]]:
    """The log with such rows masked, without temperatures that stand still, and by unit what was found; the rest as of
    `signal_faults`."""
    status = np.zeros((len(log.units), len(log.time_s)), np.uint16) if log.status is None else log.status.copy()
    found = {name: signal_faults(log, name, channels, at_rest=at_rest, by_hand=by_hand) for name in log.units}
    for k, faults in enumerate(found.values()):
        status[k, faults.saturated] |= Reason.SATURATED.value
        status[k, faults.frozen] |= Reason.FROZEN_VALUES.value
        status[k, faults.far] |= Reason.FAR_FROM_NEIGHBOURS.value
        status[k, faults.frozen_temperature] |= Reason.FROZEN_TEMPERATURE.value
    starts = next(iter(found.values())).starts
    if not status.any() and len(starts) == len(log.stretch_starts):
        return log, found
    return without_masked(replace(log, status=status, stretch_starts=starts)), found


def _stands_still(what: str, time: Floats, still: Bools) -> str:
    stretches = formulas.runs(still).tolist()
    first, last = stretches[0]
    more = f", and {len(stretches) - 1} more times" if len(stretches) > 1 else ""
    return (
        f"frozen: {what} from {time[first]:.6g} to {time[last - 1]:.6g} s{more} (the value is constant "
        f"there, but not in the rest of the record): {np.count_nonzero(still)} rows are left out"
    )


def _whole(log: Log, rows: Bools) -> Bools:
    """The rows of all standstills and moves with such rows: noise that is cut off on one side shifts a mean."""
    if log.standstill is None or not rows.any():
        return rows
    number = np.concatenate([[0], np.cumsum(np.diff(log.standstill) != 0)])
    return np.isin(number, np.unique(number[rows]))
