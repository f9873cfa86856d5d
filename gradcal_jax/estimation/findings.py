"""What a log or an estimate shows by itself to be wrong, and the sentences on what counts although no residual shows
it.

A `FitFinding` is one thing that was measured, against its limit. Gross errors, of which no estimate can be made, are
refused with a sentence of their own: units, signs, axes, the mounting, the unit of temperature.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.estimation.alignment_check import CoarseFit
from gradcal_jax.estimation.consistency import Test
from gradcal_jax.model import AXIS_NAMES, Channel, ImuModel
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.signal_checks import without_faults
from gradcal_jax.spec.absent import EARTH_IS_UNKNOWN, absent_terms
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.typical import EARTH

# Level at which by chance any of the tests of a fit fails once in a hundred.
_RARE: Final = 0.01
# K by which a die may be colder or warmer than the chamber's limits, self-heating included.
_COLDER, _WARMER = 10.0, 35.0
# K by which a converted temperature may leave the plan's range, and by which the wrong unit leaves it at least.
_FITS, _LEAVES = 10.0, 12.0
# Shares of a requirement's range by which the data may fall short of it, and the least of them, K and rad/s.
_SHORT: Final = 0.04
_SHORT_K, _SHORT_RATE = 1.5, 1e-3
# Sizes that no channel has: of a scale-factor error, of a misalignment (rad), of any coefficient in its priors.
SCALE_FACTOR_ERROR: Final = 0.5
_MISALIGNED, _PRIORS = 0.3, 50.0
# Standard deviations of the spec beyond which an error of the table contradicts the spec.
_CONTRADICTED: Final = 4.0
# How far from a whole turn the angles of an axis that wrap may end, rad.
_NEARLY: Final = np.radians(20.0)
_OTHER_UNITS: Final = (
    ("°F", lambda t: (t - 32.0) / 1.8),
    ("K", lambda t: t - 273.15),
)


class FitFinding(NamedTuple):
    """A `value` beyond its `limit` (of a test: the probability, below its level), with what to do about it, in a
    sentence; `contradicts`: the data contradict the model, and the calibration is not valid."""

    name: str
    value: float
    limit: float
    advice: str
    contradicts: bool = True


def failed(tests: Mapping[str, Test], advice: Mapping[str, str]) -> list[FitFinding]:
    """The tests that fail, each with the `advice` of its name."""
    level = _RARE / max(len(tests), 1)
    return [
        FitFinding(name, test.probability, level, advice.get(name, ""))
        for name, test in tests.items()
        if test.probability < level
    ]


def sentences_of(findings: Sequence[FitFinding]) -> list[str]:
    """All of them: which contradict the model, in one sentence, and the advice of each."""
    contradicted = [one.name.replace("_", " ") for one in findings if one.contradicts]
    whole = f"not valid: {'; '.join(contradicted)}: the data contradict the model, and no stated uncertainty is valid"
    return [*([whole] if contradicted else []), *dict.fromkeys(one.advice for one in findings if one.advice)]


def refuse_other_units(spec: Spec, temperature: np.ndarray, unit: str) -> None:
    """Raise `LogError` where a unit's temperatures (°C, finite ones count) leave the plan and fit it in another unit of
    temperature, or are beyond what the chamber can do."""
    known = temperature[np.isfinite(temperature)]
    if not len(known):
        return
    schedule: Any = spec.schedule
    segments = getattr(schedule, "segments", ())
    ends = [t for s in segments for t in (s.temperature_start, s.temperature_end)] or list(schedule.temperatures)
    low, high, (cold, warm) = float(known.min()), float(known.max()), (min(ends), max(ends))
    if low >= cold - _LEAVES and high <= warm + _WARMER:
        return
    for name, convert in _OTHER_UNITS:
        if cold - _FITS <= convert(low) and convert(high) <= warm + _FITS:
            raise LogError(
                f"{unit}: the log's temperatures, {low:.4g} … {high:.4g} °C, are outside the plan's range, {cold:g} "
                f"… {warm:g} °C, but inside it if the column is in {name} ({convert(low):.4g} … {convert(high):.4g} "
                f"°C): is the column in {name}? State its unit in the column map"
            )
    coldest, warmest = (float(t) for t in spec.rig.chamber.range)
    if low < coldest - _COLDER or high > warmest + _WARMER:
        raise LogError(
            f"{unit}: the log's temperatures, {low:.4g} … {high:.4g} °C, are outside the chamber's range, "
            f"{coldest:g} … {warmest:g} °C (rig.chamber.range): does the column map name the wrong unit, or the "
            "wrong column?"
        )


def beyond_the_data(requirement: Requirement, temperature_c: Sequence[float], rate: Sequence[float]) -> str | None:
    """A sentence where a requirement asks for temperatures (°C) or rates (rad/s) that the data do not cover."""
    parts = []
    low, high = (float(t) for t in requirement.temperature)
    short = max(_SHORT_K, _SHORT * (high - low))
    if low < temperature_c[0] - short or high > temperature_c[1] + short:
        parts.append(f"{low:g} … {high:g} °C, but the data cover {temperature_c[0]:.4g} … {temperature_c[1]:.4g} °C")
    asked = getattr(requirement, "rate", None)
    if isinstance(asked, tuple):
        slow, fast = (float(w) for w in asked)
        short = max(_SHORT_RATE, _SHORT * (fast - slow))
        if slow < rate[0] - short or fast > rate[1] + short:
            ends = (f"{np.degrees(w):.4g}" for w in (slow, fast, *rate))
            parts.append("{} … {} deg/s, but the data cover {} … {} deg/s".format(*ends))
    if not parts:
        return None
    return (
        f"requirement '{requirement.name}' asks for {'; '.join(parts)}: there is no verdict outside the range of "
        "the data; narrow the requirement, or record the missing range"
    )


def omitted_sentences(spec: Spec, temperature: np.ndarray, lag_is_fitted: bool = False) -> list[str]:
    """What the spec omits and counts in an estimate, in sentences; `temperature`: the record's (°C)."""
    # How far the dies follow the chamber does not matter to a log, which has their temperature.
    absent = [term for term in absent_terms(spec) if not term.key.endswith("thermal_lag")]
    lagging = not lag_is_fitted and (any("temperature_lag" in t.key for t in absent) or spec.sensor.temperature_lag)
    sentences: list[str] = []
    if absent:
        sentences.append(
            "not in the spec, so typical figures of the class are used: "
            + ", ".join(f"{term.key} {term.typical}" for term in absent)
            + "; enter your own figures, or 0 for an error that does not exist"
        )
    if any(term.key == EARTH for term in absent):
        sentences.append(EARTH_IS_UNKNOWN)
    if lagging and goes_one_way(temperature):
        sentences.append(
            "the temperature changes in one direction only, which hardly shows the lag of the dies behind the measured "
            "temperature: the estimate assumes zero lag, and the uncertainty includes "
            "the possible lag"
        )
    return sentences


def goes_one_way(temperature: np.ndarray) -> bool:
    """Whether a record (°C), which has noise, changes by more than 5 K and never returns by a fifth of its range."""
    fall = float(np.max(np.maximum.accumulate(temperature) - temperature))
    rise = float(np.max(temperature - np.minimum.accumulate(temperature)))
    return max(fall, rise) > 5.0 and min(fall, rise) < 0.2 * float(np.ptp(temperature))


def refuse_implausible(where: str, names: Sequence[str], values: np.ndarray, priors: np.ndarray) -> None:
    """Raise `LogError` for a channel whose coefficients no device has: names as reported (`b00`, `m_y`, `s`), values
    and the standard deviations of their priors in SI, infinite where flat."""
    by_name = dict(zip(names, map(float, values), strict=True))
    scale = next((by_name[n] for n in ("b00", "b_bin0_0", "s", "s0") if n in by_name), 0.0)
    across = {n[2:3]: v for n, v in by_name.items() if n.startswith("m_")}
    if sentence := _no_device(1.0 + scale, across):
        raise LogError(f"{where}: {sentence}")
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(priors > 0.0, np.abs(values) / priors, 0.0)
    worst = int(np.argmax(ratios)) if len(ratios) else 0
    if len(ratios) and ratios[worst] > _PRIORS:
        raise LogError(
            f"{where}: {names[worst]} is {ratios[worst]:.3g} times its prior standard deviation in the spec: does "
            "the column have another unit, or is the prior too small?"
        )


def beyond_the_spec(model: ImuModel, values: np.ndarray, priors: np.ndarray) -> Iterator[FitFinding]:
    """Each error of the table that is beyond what the spec says of it; `values` and `priors` of all reported
    parameters, as of `refuse_implausible`.

    A fault that the model lacks, such as backlash, appears as an error that the model has.
    """
    names = model.names()
    for k in range(model.calibrated, model.size):
        if abs(values[k]) > _CONTRADICTED * priors[k]:
            ratio = values[k] / priors[k]
            yield FitFinding(
                f"the table's {names[k]}",
                ratio,
                _CONTRADICTED,
                f"the table's {names[k].replace('_', ' ')} is {ratio:+.1f} times its standard deviation in the spec: "
                "is the spec of the table correct?",
            )


def wrapped_sentence(angles: np.ndarray) -> str:
    """What follows an error if an axis of the table (`angles` `(n, L)`, rad, NaN where not read) shows nearly all
    angles of one turn and none beyond it; else empty."""
    known = np.isfinite(angles)
    span = np.max(angles, axis=0, initial=-np.inf, where=known) - np.min(angles, axis=0, initial=np.inf, where=known)
    if not np.any(np.abs(span - 2.0 * np.pi) < _NEARLY):
        return ""
    return "; the table's angles stay within one turn: if they wrap at 360 deg, log angles that count whole turns"


def refuse_misaligned(name: str, fits: Mapping[str, CoarseFit], channels: Sequence[Channel]) -> None:
    """Raise `LogError` where the coarse comparison with the table shows a wrong sign, axis or unit of a channel."""
    wrong: list[tuple[str, str]] = []
    for c in channels:
        fit = fits[c.kind]
        if fit.seen[c.axis]:
            row = fit.matrix[c.axis]
            across = {AXIS_NAMES[j]: float(row[j]) for j in range(3) if j != c.axis and fit.seen[j]}
            if sentence := _no_device(float(row[c.axis]), across):
                wrong.append((f"{c.name.replace('_', ' ')}", sentence))
    if wrong:
        raise LogError(f"{name}, " + "; ".join(f"{channel}: {sentence}" for channel, sentence in wrong[:3]))


def _no_device(own: float, across: Mapping[str, float]) -> str:
    """Why a channel cannot show `own` times what is along its axis, and so much of the others; empty if it can."""
    large = [axis for axis, value in across.items() if abs(value) > _MISALIGNED * max(1.0, abs(own))]
    if abs(own - 1.0) <= SCALE_FACTOR_ERROR and not large:
        return ""
    shown = f"the output is {own:.3g} times the input along its axis"
    if large:
        parts = ", ".join(f"{across[axis]:.3g} times the input along {axis}" for axis in large)
        return (
            f"{shown}, and {parts}: are the axes of the IMU or of the table swapped, or is the body rotated by a "
            "quarter turn from the spec's mounting?"
        )
    if abs(own + 1.0) < SCALE_FACTOR_ERROR:
        return f"{shown}: its sign is opposite to the table's; change the sign of the column, or the mounting"
    for ratio, words in (
        (1.0 / 9.80665, "is the column in g instead of m/s^2?"),
        (9.80665, "is the column in m/s^2 instead of g?"),
        (180.0 / np.pi, "is the column in deg/s instead of rad/s?"),
        (np.pi / 180.0, "is the column in rad/s instead of deg/s, or are the table's angles in degrees?"),
    ):
        if abs(abs(own) / ratio - 1.0) < 0.1:
            return f"{shown}: {words}"
    return f"{shown}: does the column have another axis, unit or sign?"


# An angle within a standstill is no chance at this many standard deviations, and matters at this many of a reading.
_NO_CHANCE, _MATTERS = 6.0, 2.0
# Angle (rad) that no readings without a stated noise need to be better than.
_UNCERTAIN: Final = 1e-5


class RecordFaults(NamedTuple):
    """Of one unit: sentences on rows that are left out, and what makes the calibration not valid."""

    left_out: tuple[str, ...] = ()
    findings: tuple[FitFinding, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """All of them."""
        return *self.left_out, *(one.advice for one in self.findings)


def without_bad_rows(
    spec: Spec, logs: Sequence[Log], channels: Collection[str]
) -> tuple[list[Log], dict[str, RecordFaults]]:
    """The logs with such rows masked, and by unit what was found in any of them; `channels`: those that are estimated,
    such as "gyro x"."""
    cleaned, found = list[Log](), dict[str, RecordFaults]()
    for log in logs:
        clean, faults_of = without_faults(log, channels)
        cleaned.append(clean)
        for name, faults in faults_of.items():
            if not clean.usable(name).any():
                raise LogError(f"{name}: no usable row is left: {'; '.join(faults.sentences)}")
            before = found.get(name, RecordFaults())
            coarse = (FitFinding(what, np.nan, np.nan, sentence) for what, sentence in faults.coarse.items())
            own = {one.name: one for one in (*before.findings, *coarse, *_wrong_motion(spec, clean, name, channels))}
            found[name] = RecordFaults((*before.left_out, *faults.sentences), tuple(own.values()))
    return cleaned, found


def _wrong_motion(spec: Spec, log: Log, name: str, channels: Collection[str]) -> Iterator[FitFinding]:
    """What the rates of a unit show at the ends of standstills and within moves."""
    if log.standstill is None:
        return
    angles = [axis.angle for axis in spec.rig.table.axis]
    known = min(float(np.hypot(float(a.reading_noise), float(a.standstill_offset))) for a in angles)
    for k, label in enumerate(log.axes):
        if f"gyro {label}" not in channels:
            continue
        rate, usable = log.rate_rad_per_s[log.unit_index(name), :, k], log.usable(name)
        count, angle = estimation.lost_in_moves(log.time_s, rate, log.standstill >= 0, usable, log.stretch_starts)
        limit = max(_MATTERS * known, _UNCERTAIN)
        if angle > limit:
            yield FitFinding(
                f"samples of gyro {label} lost in moves",
                angle,
                limit,
                f"gyro {label}: samples are lost or repeated {count} times during moves. The angle of a move is "
                f"therefore uncertain by {np.degrees(angle):.2g} deg on average: record every sample, or mark the rows "
                "after lost samples as the start of a stretch",
            )
        seen = estimation.settling(log.time_s, rate, log.standstill >= 0, usable)
        if seen is None:
            continue
        for angle, std, end, words in (
            (seen.after, seen.after_std, "beginnings", "after the table is marked as at rest"),
            (seen.before, seen.before_std, "ends", "before the table is marked as moving"),
        ):
            limit = max(_NO_CHANCE * std, _MATTERS * known)
            if abs(angle) > limit:
                yield FitFinding(
                    f"gyro {label} at the {end} of standstills",
                    abs(angle),
                    limit,
                    f"gyro {label} measures a turn of {np.degrees(abs(angle)):.2g} deg {words}, averaged over all "
                    "standstills: the samples are delayed or filtered, or standstills are marked while the table still "
                    "moves",
                )


# A log that is shorter than its plan by less than this, s and as a share, is whole: runs end with their last reading.
_MISSING_S, _MISSING = 2.0, 0.01


def lacks_of(spec: Spec, logs: Sequence[Log]) -> str | None:
    """A sentence on the part of a spec's plan that its logs lack; None: they hold it all, or the plan is one of points,
    of which each that is missing is named."""
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        return None
    planned = sum(stretch.duration for stretch in schedule.stretches)
    recorded = sum(_recorded_s(log) for log in logs)
    if recorded > planned - max(_MISSING_S, _MISSING * planned):
        return None
    return f"the log ends at {recorded:.4g} s of the plan's {planned:.4g} s ({recorded / planned:.0%})"


def _recorded_s(log: Log) -> float:
    """Time of all unbroken stretches."""
    steps = np.diff(log.time_s, prepend=log.time_s[:1])
    steps[log.stretch_starts] = 0.0
    return float(steps.sum())
