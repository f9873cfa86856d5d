"""The tasks of a worker: predictions and optimisations of a sweep's points.

Predictions are those of `gradcal_jax.predict` without the parameters' covariance, warnings and error budget. NumPy
computes each point by itself, without compilation.
"""

from collections.abc import Mapping
from typing import Any, Final

from gradcal_jax.information.prediction import requirement_rows
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.sweeps.results import PointResult, Residual, one_line
from gradcal_jax.tables.writing import to_toml

Changes = Mapping[str, object]


def predict_points(base: Mapping[str, Any], points: list[tuple[int, Changes]]) -> list[PointResult]:
    """Predict the points of a chunk; a point that fails has the reason in its result."""
    return _each(base, points, _predicted)


def optimise_points(base: Mapping[str, Any], points: list[tuple[int, Changes]]) -> list[PointResult]:
    """Optimise the plan of each point and predict its residuals."""
    return _each(base, points, _optimised)


def _each(base: Mapping[str, Any], points: list[tuple[int, Changes]], do) -> list[PointResult]:
    spec = spec_of(base)
    results: list[PointResult] = []
    for index, changes in points:
        try:
            results.append(do(index, changed(spec, changes)))
        except Exception as error:
            results.append(PointResult(index, one_line(error)))
    return results


def _predicted(index: int, spec: Spec) -> PointResult:
    rows = requirement_rows(spec)
    residuals = tuple(
        Residual(k, (row.mean_of_max, row.max, row.mean, row.rms), row.verdict or "") for k, row in enumerate(rows)
    )
    return PointResult(index, "", spec.schedule.duration, spec.schedule.soak, spec.schedule.motion, residuals)


def _optimised(index: int, spec: Spec) -> PointResult:
    from gradcal_jax.design.optimise import optimise

    best = optimise(spec)
    done = _predicted(index, best.spec)
    return done._replace(before=best.before, note=best.sentence, spec=to_toml(best.spec))


TASKS: Final = {"predict": predict_points, "optimise": optimise_points}
"""The tasks of a worker, by name."""
