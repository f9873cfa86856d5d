"""Rows of calibration files that all estimators write."""

from collections.abc import Iterable, Mapping, Sequence
from math import sqrt
from typing import Any

import gradcal_jax
from gradcal_jax.calibration.file import LOG_HASH, Calibration, FitTest, Result, UnseenError
from gradcal_jax.estimation.consistency import Test
from gradcal_jax.records.log import Log
from gradcal_jax.spec.contracts import RequirementRow
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_S


def section_of(triad: GyroTriad | AccelerometerTriad, term: str) -> str:
    """The key of [sensor.gyro] or [sensor.accelerometer] from which a term was built."""
    return next(key for key in type(triad).model_fields if term.startswith(key))


def counted_std(name: str, std: float | None, unseen: Sequence[UnseenError]) -> float | None:
    """One sigma of a coefficient with the errors that no residual of the fit shows."""
    return None if std is None else sqrt(std**2 + sum(e.coefficients.get(name, 0.0) ** 2 for e in unseen))


def coefficient_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """Every coefficient of a calibration with its standard deviation, where the file has one, by the fit and
    with what no residual shows (`std_counted`), and its unit."""
    deviations, unseen = calibration.deviations(), calibration.unseen
    return [
        {
            "name": name,
            "value": value,
            "std": deviations.get(name),
            "std_counted": counted_std(name, deviations.get(name), unseen),
            "unit": term.unit,
        }
        for channel in calibration.channel
        for term in channel.term
        for name, value in ((f"{channel.name}.{n}", v) for n, v in term.coefficients.items())
    ]


def rows_of_estimate(calibration: Calibration, messages: Sequence[str], **more: Any) -> dict[str, Any]:
    """All numbers of an estimate for another program, in SI unless they have a unit beside them; `more`: those that its
    estimator adds."""
    return {
        "unit": calibration.serial_number,
        "simulated": calibration.simulated,
        "parameters": coefficient_rows(calibration),
        "covariance": None if calibration.covariance is None else calibration.covariance.model_dump(mode="json"),
        "valid_temperature_c": [float(t) for t in calibration.valid_temperature],
        "valid_rate_dps": [float(r) * DEG_PER_S for r in calibration.valid_rate],
        "tests": [row.model_dump(mode="json") for row in calibration.fit],
        "unobservable": list(calibration.unobservable),
        **more,
        "messages": list(messages),
    }


def random_walks(gyro: GyroTriad) -> dict[str, Any]:
    """A gyro's noise for a calibration file: white noise and rate random walk. Over times much shorter than its
    correlation time, a drift is a rate random walk and is added to it."""
    square = float(gyro.rate_random_walk or 0.0) ** 2
    square += sum(2.0 * float(d.standard_deviation) ** 2 / float(d.correlation_time) for d in gyro.drift)
    slow = {"rate_random_walk": Quantity.of(sqrt(square), "rad/s/sqrt(s)")} if square > 0.0 else {}
    return {"angle_random_walk": gyro.angle_random_walk, **slow}


def provenance_of(logs: Sequence[Log], unit: str, sources: Mapping[str, str], **own: str) -> dict[str, str]:
    """The provenance of a unit's calibration. `sources`: names of files; `own`: entries of the estimator."""
    texts = {key: text for key, text in {**logs[0].provenance, **sources}.items() if text}
    digests = " ".join(log.fingerprint(unit) for log in logs)
    return {"program": f"gradcal {gradcal_jax.__version__}", **own, **texts, LOG_HASH: digests}


def fit_rows(tests: Iterable[tuple[str, Test]]) -> tuple[FitTest, ...]:
    """Tests of a fit, by name, as rows of a calibration file."""
    return tuple(
        FitTest(name=name, statistic=test.statistic, degrees=test.degrees, chance=test.probability)
        for name, test in tests
    )


def result_of_requirement(row: RequirementRow) -> Result:
    """A requirement in a calibration file."""
    values: dict[str, Any] = {"value": row.judged, "worst": row.worst, "target": row.target, "verdict": row.verdict}
    values["named"] = None if row.decisive == row.judged else row.decisive
    if row.target is not None:
        values |= {"coverage": row.coverage, "rule": row.rule}
    return Result(
        name=row.name,
        axis=row.axis,
        quantity=row.quantity,
        statistic=f"{row.statistic}, 1 sigma",
        unit=row.unit,
        **{key: value for key, value in values.items() if value is not None},
    )
