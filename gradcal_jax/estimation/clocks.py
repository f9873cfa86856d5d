"""The clock over whose time a log's rates are integrated, and its uncertainty."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.sensor import HOST_CLOCK
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity

# The error of a clock that nobody stated, and of a comparison of clocks that is worth less than a quartz, ratios.
_QUARTZ = 2e-5
# Standard deviations by which two clocks contradict; and from which on the difference counts as the uncertainty of
# either clock: nothing tells which of them is wrong.
_APART, _DOUBTED = 2.0, 3.0
# Parts of a log in each of which the ratio of two clocks is compared with its mean: the shortest, s, the fewest rows,
# the most of them, and the number of standard deviations from which on a ratio differs.
_PART_S, _PART_ROWS, _PARTS, _BENT = 120.0, 50, 16, 5.0
# A comparison this near to the computer's own error adds nothing to it.
_AS_COUNTED = 1.1


@dataclass(frozen=True)
class Options:
    """Options of an estimate; `estimation.log_flow.estimate` explains each."""

    lag: float | Literal["auto"] = "auto"
    """Lag of the maps behind the measured temperature, s; "auto": estimated, and used if the data show one."""
    clock: Literal["sensor", "host"] | None = None
    """None: the spec's clock; if the spec states none and the log has both clocks, the computer's clock."""
    clock_doubt: float = 0.0
    """A further uncertainty of the clock, a ratio; at least what the log's clocks are apart, unless someone chose."""
    temperature_c: float | None = None
    """Temperature of a log without a thermometer, °C."""
    progress: Callable[[str], None] = lambda _: None
    """Called with what is being done."""


class ClockFit(NamedTuple):
    """A log's two clocks: a second of the sensor is `slope` seconds of the computer, to `std` (a ratio; None: the log
    does not say)."""

    slope: float
    std: float | None

    def apart(self, error: Quantity | None, times: float) -> bool:
        """Whether the clocks differ by more than `times` the standard deviation of their difference, by what is stated
        of them (`error`: of the sensor's)."""
        std = np.hypot(np.hypot(self.std or 0.0, HOST_CLOCK), float(error or _QUARTZ))
        return bool(abs(self.slope - 1.0) > times * std)


def clock_fit(log: Log) -> ClockFit:
    """The comparison of a log's clocks, by straight lines of one slope. Raises `LogError` without a host time.

    Each unbroken stretch has an offset of its own: at a break the sensor's clock may have been set to the host's.
    """
    if log.host_time_s is None:
        raise LogError(
            "the log has no host time to compare the sensor's clock with: sensor.clock in the spec, if it is "
            '"sensor", uses the time stamps unchanged'
        )
    starts, stds = _lines(log)
    sensor, host = _centred(log.time_s, starts), _centred(log.host_time_s, starts)
    levers = np.add.reduceat(sensor * sensor, starts)
    if not levers.any():
        raise LogError(
            "no two consecutive rows of the log are usable, so the sensor's clock cannot be compared with another"
        )
    if stds is not None:
        slopes = np.add.reduceat(sensor * host, starts) / levers
        slope = float(np.average(slopes, weights=stds**-2.0))
        return ClockFit(slope, float(np.sum(stds**-2.0)) ** -0.5)
    slope = float(sensor @ host / levers.sum())
    spread = float(np.std(host - slope * sensor))
    exact = spread <= np.spacing(max(np.abs(log.time_s).max(), np.abs(log.host_time_s).max()))
    return ClockFit(slope, None if exact else spread / float(levers.sum()) ** 0.5)


def _lines(log: Log) -> tuple[np.ndarray, np.ndarray | None]:
    """The rows at which lines begin, and the standard deviations of their slopes: the provenance of a run's log has the
    lines that were fitted to its host times; other logs have one for each stretch (None: they follow from the stamps).
    """
    rows = [int(word) for word in log.provenance.get("clock_from_row", "0").split(", ")]
    stds = np.array([float(word) for word in log.provenance.get("clock_rate_std", "").split(", ") if word])
    if len(rows) != len(stds) or not np.all(stds > 0.0):
        return log.stretch_starts, None
    return np.array(rows), stds


def _centred(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Values less the mean of their stretch."""
    counts = np.diff(starts, append=len(values))
    # Less the stretch's first value first: the mean of a computer's stamps, seconds since 1970, is rounded.
    above = values - np.repeat(values[starts], counts)
    return above - np.repeat(np.add.reduceat(above, starts) / counts, counts)


def time_of(log: Log, options: Options) -> tuple[np.ndarray, list[str]]:
    """The times (s) over which rates are integrated, by the chosen clock, and messages on that clock."""
    if (options.clock or _better_clock(log)) != "host":
        return log.time_s, []
    fit = clock_fit(log)
    known = f"1σ {fit.std * 1e6:.2g} ppm" if fit.std is not None else "the log does not state its uncertainty"
    return log.time_s[0] + fit.slope * (log.time_s - log.time_s[0]), [
        f"one second of the sensor's clock is {fit.slope:.9f} s of the computer's clock ({known}); rates are "
        "integrated over the time of the computer's clock"
    ]


def _better_clock(log: Log) -> Literal["sensor", "host"]:
    """The computer's clock, where the log has both and they can be compared better than a quartz is good."""
    try:
        fit = clock_fit(log)
    except LogError:
        return "sensor"
    if fit.std is None:
        # Equal columns are one clock; others that lie on a line to the last digit are two.
        return "sensor" if fit.slope == 1.0 else "host"
    return "host" if fit.std < _QUARTZ else "sensor"


def _bend(log: Log, fit: ClockFit) -> float:
    """How far the ratio of the clocks between parts of a log is from its mean, at most, beyond chance and beyond the
    computer's own error. (The log of a run has a line in the place of the computer's stamps.)"""
    starts, stds = _lines(log)
    if log.host_time_s is None or stds is not None or fit.std is None:
        return 0.0
    time, largest = _centred(log.time_s, starts), HOST_CLOCK
    late = _centred(log.host_time_s, starts) - fit.slope * time
    for first, end in itertools.pairwise([*starts.tolist(), len(time)]):
        count = min(int((time[end - 1] - time[first]) / _PART_S), (end - first) // _PART_ROWS, _PARTS)
        if count < 2:
            continue
        edges = np.linspace(first, end, count + 1).astype(int)
        rows = np.diff(edges)
        at, mean = (np.add.reduceat(of[first:end], edges[:-1] - first) / rows for of in (time, late))
        # Of differences of neighbours, which a bend does not change.
        square = np.add.reduceat(np.diff(late[first:end], append=late[end - 1]) ** 2, edges[:-1] - first) / (2.0 * rows)
        slope, std = np.diff(mean) / np.diff(at), np.sqrt((square / rows)[1:] + (square / rows)[:-1]) / np.diff(at)
        largest = max(largest, float(np.max(np.abs(slope), initial=0.0, where=np.abs(slope) > _BENT * std)))
    return largest if largest > HOST_CLOCK else 0.0


def with_clock(spec: Spec, logs: Sequence[Log], options: Options) -> tuple[Spec, Options, list[str]]:
    """The spec and the options of an estimate, each with what the other says of the clock; and sentences on a clock
    that contradicts the computer's.

    Where rates are integrated over the computer's clock, the clock's error is that of the comparison and of the
    computer's own clock.
    """
    chosen, error, said = options.clock or spec.sensor.clock, spec.sensor.sample_clock_error, list[str]()
    both = all(_better_clock(log) == "host" for log in logs)
    compared = chosen == "host" or (chosen is None and both)
    stamped = [log for log in logs if compared or (log.host_time_s is not None and len(log.time_s) > 1)]
    fits = [clock_fit(log) for log in stamped]
    apart = [fit for fit in fits if fit.apart(error, _APART)]
    # The better of the two, unless the sensor's is contradicted.
    better = error is None or spec.sensor.takes_host_clock or apart
    clock = chosen or ("host" if both and better else "sensor")
    if clock == "sensor" and not stamped and float(error or 0.0) > 0.0:
        said.append(
            "the log does not compare the sensor's clock with the computer's, so it cannot show a clock error beyond "
            f"the stated {error}: such an error is a scale-factor error of the same size, also where it depends on "
            "temperature, as of a crystal without compensation (some 70 ppm at -20 degC). Log the computer's time, too"
        )
    # Who states which clock counts answers for it.
    doubted = [] if chosen else [fit for fit in apart if fit.apart(error, _DOUBTED)]
    bend = max(map(_bend, stamped, fits), default=0.0)
    doubt = max([options.clock_doubt, bend, *(abs(fit.slope - 1.0) for fit in doubted)])
    # Every log has a slope of its own to the host's clock; the error that they share is at most the largest.
    std = max((float(np.hypot(fit.std or 0.0, HOST_CLOCK)) for fit in fits), default=np.inf)
    omitted = spec.sensor.clock is None and error is None
    if not (omitted and clock == "host" and std < _AS_COUNTED * HOST_CLOCK):
        # Otherwise the computer's clock counts as in a prediction: as a term that the spec omits.
        counted: dict[str, object] = {"clock": "sensor"}
        if clock == "host":
            counted["sample_clock_error"] = Quantity.of(std, "ppm")
        spec = spec.model_copy(update={"sensor": spec.sensor.model_copy(update=counted)})
    for fit in apart:
        said.append(
            f"the log's two clocks contradict each other: they differ by {abs(fit.slope - 1.0) * 1e6:.4g} ppm, more "
            f"than {_APART:g} times the uncertainty of the sensor's clock; the "
            f"{'computer' if clock == 'host' else 'sensor'}'s clock is used (sensor.clock in the spec chooses)"
        )
    if doubted:
        said.append(
            "this difference of the clocks counts as uncertainty of the scale factors, since the computer's clock may "
            "be the wrong one: if the sensor's is as poor, state this as sample_clock_error, or state the clock"
        )
    if bend:
        said.append(
            f"the log's two clocks do not keep one ratio: in parts of the log it differs by up to {bend * 1e6:.3g} ppm "
            "from its mean, which counts as uncertainty of the scale factors: was the computer's clock set during the "
            "log, or does the sensor's depend on temperature?"
        )
    return spec, replace(options, clock=clock, clock_doubt=doubt), said
