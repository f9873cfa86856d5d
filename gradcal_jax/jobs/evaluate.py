"""The tasks of a worker: predictions and optimisations of a sweep's points, and recipes.

Predictions are those of `gradcal_jax.api.predict` without the parameters' covariance, warnings and error budget. NumPy
computes each point by itself, without compilation.
"""

from collections.abc import Mapping
from typing import Any, Final

from gradcal_jax.api.prediction import requirement_rows
from gradcal_jax.files import changed, spec_of, to_toml
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.jobs.results import PointResult, Residual, one_line

_HEADER = "Made by gradcal recipes; `gradcal show` prints it as a table."
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
        # One value for all elements, stored under the first axis.
        Residual(k, "x", (row.mean_of_max, row.max, row.mean, row.rms), row.verdict or "")
        for k, row in enumerate(rows)
    )
    return PointResult(index, "", spec.schedule.duration, spec.schedule.soak, spec.schedule.motion, residuals)


def _optimised(index: int, spec: Spec) -> PointResult:
    from gradcal_jax.api.flow import optimise

    best = optimise(spec)
    done = _predicted(index, best.spec)
    return done._replace(before=best.before, note=best.sentence, spec=to_toml(best.spec))


def recommend(tables: Mapping[str, Any]) -> dict[str, Any]:
    """The optimised recipe of a spec as TOML text, and its row of the summary. Errors: `ValueError` as `optimise`'s."""
    from gradcal_jax.api.flow import optimise
    from gradcal_jax.api.recipe import recipe

    spec = spec_of(tables)
    best = optimise(spec)
    executable = recipe(best)
    wanted = None if spec.design is None else spec.design.minimise
    decisive = next((row for row in executable.prediction.requirements if row.name == wanted), None)
    limit = least_possible(spec)
    return {
        "toml": to_toml(executable, header=_HEADER),
        "objective": best.name,
        "unit": best.unit,
        "before": best.before,
        "now": best.now,
        "limit": limit,
        "efficiency": None if limit is None or best.now <= 0.0 else limit / best.now,
        "hours": executable.duration_s / 3600.0,
        "verdict": (decisive.verdict if decisive is not None else None) or "",
        "limited_by": (decisive.limited_by if decisive is not None else None) or "",
        "converged": best.converged,
        "sentence": best.sentence,
    }


def least_possible(spec: Spec) -> float | None:
    """The proven lower limit for any plan on this rig in this time, in the objective's unit; None without a proof."""
    from gradcal_jax.api.limit import limits

    try:
        return next((row.certified for row in limits(spec) if spec.design and row.name == spec.design.minimise), None)
    except ValueError:
        return None


TASKS: Final = {"predict": predict_points, "optimise": optimise_points, "recommend": recommend}
"""The tasks of a worker, by name."""
