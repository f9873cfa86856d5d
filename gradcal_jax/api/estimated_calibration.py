"""The calibration file of an estimate."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from gradcal_jax.api.contract_rows import fit_rows, provenance_of, random_walks, result_of_requirement, section_of
from gradcal_jax.api.estimate_options import Lag, Options
from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.api.plan_sentences import prior_deviations, unobserved_parameters
from gradcal_jax.estimation import Consistency, ImuEstimate, Test
from gradcal_jax.files.calibration import (
    FORMAT,
    ORDER,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    Noise,
    PathCoefficient,
    Residuals,
    TableError,
    build_term,
)
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.log import Log
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.model import (
    AXIS_NAMES,
    SECOND,
    Channel,
    Discrepancy,
    GradientOfBias,
    Hysteresis,
    Map,
    OwnTerm,
    PathTerm,
    SignalMap,
    TemperatureDifference,
)


def tests_by_name(tests: Consistency, channels: dict[str, tuple[Test, Test]]) -> dict[str, Test]:
    """All tests of a fit, by the names that they have in the calibration file."""
    named = {"chi-squared of the fit": tests.fit}
    for channel, (size, white) in channels.items():
        # That of a single channel is the whole fit's.
        named |= {f"{channel}: chi-squared": size} if len(channels) > 1 else {}
        named[f"{channel}: whiteness"] = white
    return named | {split.name: split.agreement for split in tests.splits}


def calibration_of(
    built: BuiltImu,
    logs: Sequence[Log],
    name: str,
    solution: ImuEstimate,
    tests: Consistency,
    channels: dict[str, tuple[Test, Test]],
    requirements: tuple[RequirementRow, ...],
    covered: tuple[tuple[float, float], tuple[float, float]],
    lag: Lag,
    options: Options,
    sources: dict[str, str],
) -> Calibration:
    """The calibration of a sensor of this `name`; `covered`: temperatures (°C) and rates (rad/s)."""
    model, spec, named = built.model, built.spec, tests_by_name(tests, channels)
    reported = model.to_reported
    values, deviations = reported @ solution.parameters, solution.known.deviations(reported)
    names, units = model.names(), model.units()
    priors = prior_deviations(built)
    own = slice(0, model.calibrated)
    held = [
        one.model_copy(update={"residuals": residuals_of(solution.residuals_of(k))})
        for k, one in enumerate(calibrated_channels(built, values, covered, lag.seconds))
    ]
    kept = {f"{c.name}.{n}" for c in held for term in c.term for n in term.coefficients}
    covariant = [k for k in range(model.calibrated) if np.isfinite(deviations[k]) and names[k] in kept]
    matrix = solution.known.covariance(reported[own])[np.ix_(covariant, covariant)]
    frame = spec.sensor.frame
    case = frame is not None and frame.fixed_by == "case"
    section: dict[str, Any] = {
        "format": FORMAT,
        "title": spec.title or spec.sensor.name or f"calibration of {name}",
        "serial_number": name,
        "simulated": any(one.simulated for one in logs),
        "frame": "the case, as far as its mounting is known"
        if case
        else "the table's axes at zero, through the nominal mounting",
        "order": ORDER,
        "channel": tuple(held),
        "path": tuple(_path_coefficients(built, values, deviations)),
        "covariance": Covariance(
            names=tuple(names[k] for k in covariant), matrix=tuple(map(tuple, matrix.tolist()))
        ),
        "table": tuple(
            TableError(
                name=names[k], value=float(values[k]), standard_deviation=float(deviations[k]), prior=float(priors[k]),
                unit=units[k],
            )
            for k in range(model.calibrated, model.size)
        ),
        "fit": fit_rows(named.items()),
        "unobservable": tuple(n for n in unobserved_parameters(built, solution.known) if n in kept),
        "noise": _noise(spec, logs[0]),
        "result": tuple(map(result_of_requirement, requirements)),
        "provenance": provenance_of(
            logs,
            name,
            sources,
            estimator=_estimator(solution, lag, options),
            rows=str(int(np.count_nonzero(solution.used))),
        ),
    }  # fmt: skip
    return Calibration(**section)


def _estimator(solution: ImuEstimate, lag: Lag, options: Options) -> str:
    parts = [f"Gauss-Newton with finite rotations, {solution.rounds} iterations"]
    if np.any(solution.weights < 1.0):
        parts.append("robust (Huber)")
    if lag.std is not None:
        parts.append(f"lag fitted: {lag.seconds:.4g} s, 1 sigma {lag.std:.2g} s")
    if options.smoothness == "auto":
        parts.append("smoothness by marginal likelihood")
    if options.clock == "host":
        parts.append("time of the computer")
    return "; ".join(parts)


def residuals_of(white: np.ndarray) -> Residuals:
    """The histogram of whitened residuals (in standard deviations, in order of time), and their rms along the run."""
    counts = np.histogram(white, np.concatenate([[-np.inf], np.arange(-4.0, 4.25, 0.5), [np.inf]]))[0]
    tenths = np.array_split(white, 10) if len(white) >= 100 else []
    return Residuals(counts=tuple(counts.tolist()), rms=tuple(float(np.sqrt(np.mean(part**2))) for part in tenths))


def calibrated_channels(
    built: BuiltImu, values: np.ndarray, covered: tuple[tuple[float, float], tuple[float, float]], lag: Any = None
) -> Iterator[CalibratedChannel]:
    """The calibrated channels, from all reported parameters `(p,)`; `covered`: temperatures (°C) and rates (rad/s)."""
    begin = 0
    shared: dict[str, Any] = {
        "valid_temperature": tuple(f"{t:.1f} degC" for t in covered[0]),
        "valid_rate": tuple(f"{np.degrees(r):.1f} deg/s" for r in covered[1]),
    }
    shared |= {"thermal_lag": Quantity.of(float(lag), "s")} if lag else {}
    for c in built.model.channels:
        terms = _terms(built.spec, c, values[begin : begin + c.model.size])
        yield CalibratedChannel(kind=c.kind, axis=AXIS_NAMES[c.axis], term=tuple(terms), **shared)
        begin += c.model.size


def _terms(spec: Spec, channel: Channel, values: np.ndarray) -> Iterator[CalibratedTerm]:
    triad = getattr(spec.sensor, channel.kind)
    for term in channel.model.terms:
        # A sensitivity to dT/dt and what else depends on the path of temperature are estimated beside the calibration.
        if isinstance(term, Discrepancy | GradientOfBias | PathTerm | OwnTerm):
            continue
        own = values[channel.model.where(term.name)]
        coefficients = {name: float(v) for name, v in zip(term.names(), own, strict=True)}
        section = getattr(triad, section_of(triad, term.name))
        assert isinstance(term, Map | SignalMap)
        of_rate = (f"rate {AXIS_NAMES[channel.axis]}",)
        signals = term.signals if isinstance(term, SignalMap) else () if term.rate is None else of_rate
        bases = {"temperature": section.temperature, "rate": getattr(section, "rate", None)}
        bases |= {"lag": Quantity.of(term.late.lag, "s")} if term.late is not None else {}
        yield build_term(term.name, term.unit, signals, coefficients, **bases)


def _path_coefficients(built: BuiltImu, values: np.ndarray, deviations: np.ndarray) -> Iterator[PathCoefficient]:
    """Path-of-temperature terms, estimated in addition to the maps, from all reported parameters."""
    begin = 0
    for c in built.model.channels:
        for term in c.model.terms:
            own = slice(begin, begin + term.size)
            begin = own.stop
            if not isinstance(term, PathTerm | GradientOfBias | OwnTerm):
                continue
            of_path: dict[str, Any] = {}
            if isinstance(term, Hysteresis):
                of_path["width"] = Quantity.of(float(term.width), "K")
            elif isinstance(term, TemperatureDifference) and term.other.name == SECOND:
                of_path["second_thermometer"] = True
            elif isinstance(term, OwnTerm):
                of_path["own"] = True
            elif isinstance(term, TemperatureDifference):
                of_path["time_constant"] = Quantity.of(term.other.lag, "s")
            for name, value, std in zip(term.names(), values[own], deviations[own], strict=True):
                if not isinstance(term, PathTerm) or name not in term.nuisances:
                    yield PathCoefficient(
                        channel=c.name, name=name, value=float(value), standard_deviation=float(std), unit=term.unit,
                        **of_path,
                    )  # fmt: skip


def _noise(spec: Spec, log: Log) -> Noise:
    densities: dict[str, Any] = {"sample_rate": Quantity.of(1.0 / log.sample_interval_s, "Hz")}
    if (gyro := spec.sensor.gyro) is not None:
        densities |= random_walks(gyro)
    if (force := spec.sensor.accelerometer) is not None:
        densities["velocity_random_walk"] = force.velocity_random_walk
    return Noise(**densities)
