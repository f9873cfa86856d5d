"""Targets of requirements in their display units, decision rules, and verdicts on residuals; and the rows of
calibration files that all estimators write."""

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from math import erfc, sqrt
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

import gradcal_jax
from gradcal_jax.information.residual import Statistic
from gradcal_jax.spec.requirement import MissionHeadingRequirement, Requirement
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_H, PPM, G

PrintedUnit = Literal["ppm", "deg/h", "urad", "deg/h/g", "ug", "ug/g^2", "deg"]
UNIT_OF: Final[dict[str, tuple[PrintedUnit, float]]] = {
    "scale_factor": ("ppm", PPM),
    "bias": ("deg/h", DEG_PER_H),
    "mission_heading": ("deg", float(np.degrees(1.0))),
    "gyro_bias": ("deg/h", DEG_PER_H),
    "gyro_scale_factor": ("ppm", PPM),
    "gyro_misalignment": ("urad", 1e6),
    "g_sensitivity": ("deg/h/g", DEG_PER_H * G),
    "accelerometer_bias": ("ug", 1e6 / G),
    "accelerometer_scale_factor": ("ppm", PPM),
    "accelerometer_misalignment": ("urad", 1e6),
    "second_order": ("ug/g^2", 1e6 * G),
}
"""For each quantity: its unit in output, and the number of these units in one SI unit."""


def mission_weights(requirement: Requirement, name: Statistic) -> np.ndarray:
    """Factors `(n, 1)` of the residuals of missions that make a plain statistic the weighted one."""
    if not isinstance(requirement, MissionHeadingRequirement) or name not in ("rms", "mean"):
        return np.ones((1, 1))
    share = np.array([[mission.weight] for mission in requirement.mission])
    share = share / np.mean(share)
    return np.sqrt(share) if name == "rms" else share


def target_of(requirement: Requirement) -> float | None:
    """The target in the unit of `UNIT_OF`."""
    return None if requirement.target is None else float(requirement.target) * UNIT_OF[requirement.quantity][1]


def limit_of(requirement: Requirement) -> tuple[Statistic, float] | None:
    """The limit that a target sets to the residual map (1σ): the requirement's own statistic, and its largest allowed
    value (`UNIT_OF`), `target / coverage` (simple acceptance, JCGM 106, 8.2)."""
    target = target_of(requirement)
    return None if target is None else (requirement.statistic, target / requirement.coverage)


def decision_rule(requirement: Requirement) -> str:
    """The decision rule of a target, in words. Empty without one."""
    if requirement.target is None:
        return ""
    of = f"{requirement.coverage:g} × " if requirement.coverage != 1.0 else ""
    return f"simple acceptance: {of}{requirement.statistic} (1σ) within {requirement.target}"


def specific_risk(y: float, u: float, limit: float) -> float:
    """Probability that an error with estimate `y` and standard uncertainty `u` lies beyond ±`limit` (JCGM 106, 7.2)."""
    if u == 0.0:
        return float(abs(y) > limit)
    below, above = ((limit + sign * y) / (sqrt(2.0) * u) for sign in (1.0, -1.0))
    return 0.5 * (erfc(below) + erfc(above))


def verdict_of(
    requirement: Requirement, statistic_named: Callable[[Statistic], float]
) -> Literal["met", "missed", "unobservable"] | None:
    """The verdict by a requirement's decision rule; None without a target. `statistic_named`: the residual's statistics
    by name (in `UNIT_OF`, 1σ), infinite where it is not observable."""
    if not np.isfinite(statistic_named(requirement.statistic)):
        return "unobservable"
    limit = limit_of(requirement)
    if limit is None:
        return None
    return "met" if statistic_named(limit[0]) <= limit[1] else "missed"


def run_of(requirement: Requirement) -> Literal["any run", "this run"]:
    """Whether the bias of another power-on counts."""
    return getattr(requirement, "of", "this run")


if TYPE_CHECKING:
    from gradcal_jax.calibration import Calibration, Covariance, FitTest, Result, UnseenError
    from gradcal_jax.estimation import Test
    from gradcal_jax.records.log import Log
    from gradcal_jax.tables.contracts import RequirementRow


def finite(value: float | None) -> float | None:
    """The value, or None where it is not finite: JSON knows no infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


def section_of(triad: GyroTriad | AccelerometerTriad, term: str) -> str:
    """The key of [sensor.gyro] or [sensor.accelerometer] from which a term was built."""
    return next(key for key in type(triad).model_fields if term.startswith(key))


def deviations_of(covariance: "Covariance | None") -> dict[str, float]:
    """One sigma of every coefficient that has one."""
    return {} if covariance is None else {n: sqrt(covariance.matrix[k][k]) for k, n in enumerate(covariance.names)}


def counted_std(name: str, std: float | None, unseen: "Sequence[UnseenError]") -> float | None:
    """One sigma of a coefficient with the errors that no residual of the fit shows."""
    return None if std is None else sqrt(std**2 + sum(e.coefficients.get(name, 0.0) ** 2 for e in unseen))


def coefficient_rows(calibration: "Calibration") -> list[dict[str, Any]]:
    """Every coefficient of a calibration with its standard deviation, where the file has one, by the fit and
    with what no residual shows (`std_counted`), and its unit."""
    deviations, unseen = deviations_of(calibration.covariance), calibration.unseen
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


def random_walks(gyro: GyroTriad) -> dict[str, Any]:
    """A gyro's noise for a calibration file: white noise and rate random walk. Over times much shorter than its
    correlation time, a drift is a rate random walk and is added to it."""
    square = float(gyro.rate_random_walk or 0.0) ** 2
    square += sum(2.0 * float(d.standard_deviation) ** 2 / float(d.correlation_time) for d in gyro.drift)
    slow = {"rate_random_walk": Quantity.of(sqrt(square), "rad/s/sqrt(s)")} if square > 0.0 else {}
    return {"angle_random_walk": gyro.angle_random_walk, **slow}


def versions_of(packages: Sequence[str]) -> dict[str, str]:
    """The versions of Python and of those of `packages` that are installed."""
    versions = {"python": platform.python_version()}
    for name in packages:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def provenance_of(logs: "Sequence[Log]", unit: str, sources: Mapping[str, str], **own: str) -> dict[str, str]:
    """The provenance of a unit's calibration. `sources`: names of files; `own`: entries of the estimator."""
    from gradcal_jax.calibration import LOG_HASH

    texts = {key: text for key, text in {**logs[0].provenance, **sources}.items() if text}
    digests = " ".join(log.fingerprint(unit) for log in logs)
    return {"program": f"gradcal {gradcal_jax.__version__}", **own, **texts, LOG_HASH: digests}


def fit_rows(tests: "Iterable[tuple[str, Test]]") -> "tuple[FitTest, ...]":
    """Tests of a fit, by name, as rows of a calibration file."""
    from gradcal_jax.calibration import FitTest

    return tuple(
        FitTest(name=name, statistic=test.statistic, degrees=test.degrees, chance=test.probability)
        for name, test in tests
    )


def judged_by_data(row: "RequirementRow", beyond: str | None, contradicted: Sequence[str]) -> "RequirementRow":
    """A requirement as an estimate meets it: no verdict where the data lack what it asks for (`beyond`), or contradict
    the model."""
    verdict = "not covered" if beyond and row.verdict in ("met", "missed") else row.verdict
    return row.model_copy(update={"verdict": "not valid" if contradicted else verdict})


def result_of_requirement(row: "RequirementRow") -> "Result":
    """A requirement in a calibration file."""
    from gradcal_jax.calibration import Result

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
