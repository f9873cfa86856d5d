"""The calibration file of a fit: channels, covariance, tests, requirements, provenance."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from gradcal_jax.calibration.file import (
    FORMAT,
    FRAME_OF_CASE,
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
from gradcal_jax.estimation.calibration_rows import random_walks, section_of
from gradcal_jax.estimation.imu_solve import ImuEstimate
from gradcal_jax.information.plan_sentences import prior_deviations, unobserved_parameters
from gradcal_jax.information.unseen import CountedPosteriors, unseen_errors
from gradcal_jax.model import (
    AXIS_NAMES,
    Channel,
    Discrepancy,
    GradientOfBias,
    Hysteresis,
    Map,
    OwnTerm,
    ProductTerm,
)
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.model.nodes import INPUTS
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity

Range = tuple[float, float]
_FRAME_OF_TABLE = "the table's axes at zero angles, rotated by the nominal mounting"
# Edges of the histogram of whitened residuals, and the fewest residuals whose rms along the run is shown.
_EDGES = np.concatenate([[-np.inf], np.arange(-4.0, 4.25, 0.5), [np.inf]])
_FEWEST, _PARTS = 100, 10


def calibration_of(
    built: BuiltImu,
    logs: Sequence[Log],
    name: str,
    solution: ImuEstimate,
    covered: tuple[Range, Range],
    lag: float,
    budget: CountedPosteriors,
    **said: Any,
) -> Calibration:
    """The calibration of a sensor of this `name`; `covered`: temperatures (°C) and rates (rad/s); `lag` s of the maps;
    `budget`: the errors that it counts; `said`: further sections of the file."""
    model, spec, reported = built.model, built.spec, built.model.to_reported
    values, deviations = reported @ solution.parameters, solution.known.deviations(reported)
    names, units, priors = model.names(), model.units(), prior_deviations(model)
    channels = tuple(
        one.model_copy(update={"residuals": residuals_of(solution.residuals[solution.channel == k])})
        for k, one in enumerate(calibrated_channels(built, values, covered, lag))
    )
    carried = {f"{c.name}.{n}" for c in channels for term in c.term for n in term.coefficients}
    kept = [k for k, n in enumerate(names) if n in carried]
    seen = [k for k in kept if np.isfinite(deviations[k])]
    matrix = solution.known.covariance(reported[: model.calibrated])[np.ix_(seen, seen)]
    said["unseen"] = unseen_errors(budget, [names[k] for k in kept], reported[kept])
    return Calibration(
        format=FORMAT,
        title=spec.title or f"calibration of {name}",
        serial_number=name,
        simulated=any(one.simulated for one in logs),
        frame=FRAME_OF_CASE if spec.sensor.frame == "case" else _FRAME_OF_TABLE,
        order=ORDER,
        channel=channels,
        path=tuple(_path_coefficients(built, values, deviations)),
        covariance=Covariance(names=tuple(names[k] for k in seen), matrix=tuple(map(tuple, matrix.tolist()))),
        table=tuple(
            TableError(
                name=names[k],
                value=float(values[k]),
                standard_deviation=float(deviations[k]),
                prior=float(priors[k]),
                unit=units[k],
            )
            for k in range(model.calibrated, model.size)
        ),
        unobservable=tuple(n for n in unobserved_parameters(model, solution.known) if n in carried),
        noise=_noise(spec, logs[0]),
        **{key: value for key, value in said.items() if value},
    )


def residuals_of(white: np.ndarray) -> Residuals:
    """The histogram of whitened residuals (in standard deviations, in order of time), and their rms along the run."""
    parts = np.array_split(white, _PARTS) if len(white) >= _FEWEST else []
    counts = np.histogram(white, _EDGES)[0]
    return Residuals(counts=tuple(counts.tolist()), rms=tuple(float(np.sqrt(np.mean(part**2))) for part in parts))


def calibrated_channels(
    built: BuiltImu, values: np.ndarray, covered: tuple[Range, Range], lag: float = 0.0
) -> Iterator[CalibratedChannel]:
    """The calibrated channels, from all reported parameters `(p,)`; `covered`: temperatures (°C) and rates (rad/s)."""
    begin = 0
    shared: dict[str, Any] = {
        "valid_temperature": tuple(f"{t:.1f} degC" for t in covered[0]),
        "valid_rate": tuple(f"{np.degrees(r):.1f} deg/s" for r in covered[1]),
    }
    shared |= {"thermal_lag": Quantity.of(float(lag), "s")} if lag else {}
    for c in built.model.channels:
        terms = _terms(built.spec, c, values[begin : begin + c.size])
        yield CalibratedChannel(kind=c.kind, axis=AXIS_NAMES[c.axis], term=tuple(terms), **shared)
        begin += c.size


def _terms(spec: Spec, channel: Channel, values: np.ndarray) -> Iterator[CalibratedTerm]:
    triad = getattr(spec.sensor, channel.kind)
    for term in channel.terms:
        # A sensitivity to dT/dt and what else depends on the path of temperature are estimated beside the calibration.
        if isinstance(term, Discrepancy | GradientOfBias | OwnTerm):
            continue
        own = values[channel.where(term.name)]
        coefficients = {name: float(v) for name, v in zip(term.names(), own, strict=True)}
        section = getattr(triad, section_of(triad, term.name))
        assert isinstance(term, Map)
        bases = {"temperature": section.temperature, "rate": getattr(section, "rate", None)}
        yield build_term(term.name, term.unit, term.signals, coefficients, **bases)


def _path_coefficients(built: BuiltImu, values: np.ndarray, deviations: np.ndarray) -> Iterator[PathCoefficient]:
    """Path-of-temperature terms, estimated in addition to the maps, from all reported parameters."""
    begin = 0
    for c in built.model.channels:
        own_input = (f"{INPUTS[c.kind]} {AXIS_NAMES[c.axis]}",)
        for term in c.terms:
            own = slice(begin, begin + term.size)
            begin = own.stop
            if not isinstance(term, OwnTerm | GradientOfBias):
                continue
            of_path: dict[str, Any] = {}
            if isinstance(term, Hysteresis):
                of_path["width"] = Quantity.of(float(term.width), "K")
            elif isinstance(term, OwnTerm):
                by_slope = isinstance(term, ProductTerm) and term.signals in ((), own_input) and term.slopes == 1
                of_path["own"] = not by_slope
            for name, value, std in zip(term.names(), values[own], deviations[own], strict=True):
                if isinstance(term, OwnTerm) and name in term.nuisances:
                    continue
                yield PathCoefficient(
                    channel=c.name,
                    name=name,
                    value=float(value),
                    standard_deviation=float(std),
                    unit=term.unit,
                    **of_path,
                )


def _noise(spec: Spec, log: Log) -> Noise:
    densities: dict[str, Any] = {"sample_rate": Quantity.of(1.0 / log.sample_interval_s, "Hz")}
    if (gyro := spec.sensor.gyro) is not None:
        densities |= random_walks(gyro)
    if (force := spec.sensor.accelerometer) is not None:
        densities["velocity_random_walk"] = force.velocity_random_walk
    return Noise(**densities)
