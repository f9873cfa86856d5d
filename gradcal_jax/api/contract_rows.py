"""Rows common to the contracts of a single axis and of a whole unit: maps, bases, shapes of moves."""

from collections.abc import Iterable, Mapping, Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import gradcal_jax
from gradcal_jax.files.bases import (
    RateBasis,
    RatePolynomial,
    RateSpline,
    TemperatureBasis,
    TemperaturePolynomial,
    TemperatureSpline,
)
from gradcal_jax.files.contracts import BasisRow, DiscrepancyRow, Functions, MapRow, ProcessRow
from gradcal_jax.files.moves import ResolvedMove
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.sensor import AccelerometerTriad, Bias, GyroTriad, ScaleFactor, ScaleFactorDiscrepancy, Sensor
from gradcal_jax.trajectory import Move

if TYPE_CHECKING:
    from gradcal_jax.estimation import Test
    from gradcal_jax.files.calibration import Covariance, FitTest
    from gradcal_jax.files.log import Log
    from gradcal_jax.files.unit_calibration import UnitCalibration


def shape_row(move: Move | ResolvedMove, angle: float) -> dict[str, Any]:
    """The shape of a move and its parameters, by their names in the contract."""
    row: dict[str, Any] = {"shape": move.shape, "peak_rate": float(move.peak_rate), "angle": angle}
    if move.shape in ("cosine ramps", "linear ramps"):
        row["ramp"] = float(move.ramp)
    elif move.shape == "sinusoid":
        row["cycles"] = move.cycles
    elif move.shape == "spline":
        row["controls"] = tuple(float(c) for c in move.controls)
    elif move.shape == "hand":
        row["unevenness"] = float(move.unevenness)
    return row


def map_row(section: Bias | ScaleFactor) -> MapRow:
    """A gyro's bias or scale factor as a row of the contracts."""
    beyond, smooth = section.discrepancy, section.smoothness is not None
    by_rate = isinstance(section, ScaleFactor)
    return MapRow(
        temperature=basis_row(section.temperature, smooth),
        rate=basis_row(section.rate, smooth) if by_rate else None,
        prior=as_number(section.prior),
        smoothness=as_number(section.smoothness),
        smoothness_along=_along(section) if smooth else (),
        discrepancy=None
        if beyond is None
        else DiscrepancyRow(
            sigma=float(beyond.standard_deviation),
            functions="legendre",
            temperature_degree=beyond.temperature_degree,
            rate_degree=beyond.rate_degree if isinstance(beyond, ScaleFactorDiscrepancy) else None,
        ),
    )


def _along(section: Bias | ScaleFactor) -> tuple[Literal["temperature", "rate"], ...]:
    """The axes along which smoothness acts; the coefficients of a polynomial have no neighbours."""
    axes: list[Literal["temperature", "rate"]] = []
    if not isinstance(section.temperature, TemperaturePolynomial):
        axes.append("temperature")
    if isinstance(section, ScaleFactor) and not isinstance(section.rate, RatePolynomial):
        axes.append("rate")
    return tuple(axes)


def basis_row(section: TemperatureBasis | RateBasis, smooth: bool) -> BasisRow:
    """A basis as a row. `smooth`: whether the map's (reported) coefficients have a smoothness prior."""
    if isinstance(section, TemperaturePolynomial | RatePolynomial):
        return BasisRow(
            basis="polynomial",
            degree=section.degree,
            centre=float(section.centre),
            scale=float(section.scale),
            prior_functions="monomial",
            smoothness_functions="monomial" if smooth else None,
        )
    own: Functions = section.basis
    alike: dict = {"basis": own, "prior_functions": own, "smoothness_functions": own if smooth else None}
    if isinstance(section, TemperatureSpline | RateSpline):
        return BasisRow(degree=section.degree, knots=tuple(float(k) for k in section.knots), **alike)
    return BasisRow(edges=tuple(float(e) for e in section.edges), **alike)


def as_number(value: float | None) -> float | None:
    """A quantity as a plain number."""
    return None if value is None else float(value)


def finite(value: float | None) -> float | None:
    """The value, or None where it is not finite: JSON knows no infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


def process_rows(sections: Iterable[Any]) -> tuple[ProcessRow, ...]:
    """Drifts, or instabilities of the scale factor."""
    return tuple(ProcessRow(sigma=float(r.standard_deviation), tau=float(r.correlation_time)) for r in sections)


def temperatures_between(times: Any, chamber: Any, begin: float, end: float) -> dict[str, Any]:
    """The chamber's temperature (°C) at both ends of a segment (s), and its bends between them."""
    bends = [(float(t), float(c)) for t, c in zip(times, chamber, strict=True) if begin + 1e-6 < t < end - 1e-6]
    first, last = (float(c) for c in np.interp([begin, end], times, chamber))
    return {"temperature_start": first, "temperature_end": last, "temperature_bends": tuple(bends) or None}


def section_of(triad: GyroTriad | AccelerometerTriad, term: str) -> str:
    """The key of [sensor.gyro] or [sensor.accelerometer] from which a term was built."""
    return next(key for key in type(triad).model_fields if term.startswith(key) or key == "cross_coupling")


def deviations_of(covariance: "Covariance | None") -> dict[str, float]:
    """One sigma of every coefficient that has one."""
    return {} if covariance is None else {n: sqrt(covariance.matrix[k][k]) for k, n in enumerate(covariance.names)}


def coefficient_rows(calibration: "UnitCalibration") -> list[dict[str, Any]]:
    """Every coefficient of a unit's calibration with its standard deviation, where the file has one, and its unit."""
    deviations = deviations_of(calibration.covariance)
    return [
        {"name": name, "value": value, "std": deviations.get(name), "unit": term.unit}
        for channel in calibration.channel
        for term in channel.term
        for name, value in ((f"{channel.name}.{n}", v) for n, v in term.coefficients.items())
    ]


def random_walks(gyro: "Sensor | GyroTriad") -> dict[str, Any]:
    """A gyro's noise for a calibration file: white noise and rate random walk. Over times much shorter than its
    correlation time, a drift is a rate random walk and is added to it."""
    square = float(gyro.rate_random_walk or 0.0) ** 2
    square += sum(2.0 * float(d.standard_deviation) ** 2 / float(d.correlation_time) for d in gyro.drift)
    slow = {"rate_random_walk": Quantity.of(sqrt(square), "rad/s/sqrt(s)")} if square > 0.0 else {}
    return {"angle_random_walk": gyro.angle_random_walk, **slow}


def provenance_of(logs: "Sequence[Log]", unit: str, sources: Mapping[str, str], **own: str) -> dict[str, str]:
    """The provenance of a unit's calibration. `sources`: names of files; `own`: entries of the estimator."""
    from gradcal_jax.files.calibration import LOG_HASH

    texts = {key: text for key, text in {**logs[0].provenance, **sources}.items() if text}
    digests = " ".join(log.fingerprint(unit) for log in logs)
    return {"program": f"gradcal {gradcal_jax.__version__}", **own, **texts, LOG_HASH: digests}


def fit_rows(tests: "Iterable[tuple[str, Test]]") -> "tuple[FitTest, ...]":
    """Tests of a fit, by name, as rows of a calibration file."""
    from gradcal_jax.files.calibration import FitTest

    return tuple(
        FitTest(name=name, statistic=test.statistic, degrees=test.degrees, chance=test.probability)
        for name, test in tests
    )
