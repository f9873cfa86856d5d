"""Results of a sweep as labelled arrays with units (xarray), and their file (netCDF 4)."""

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gradcal_jax.information import STATISTICS
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.sweeps.points import Points
from gradcal_jax.sweeps.results import PointResult
from gradcal_jax.sweeps.sweep_file import Sweep
from gradcal_jax.tables.netcdf import NetcdfError, load_netcdf
from gradcal_jax.tables.writing import to_toml

if TYPE_CHECKING:
    import xarray

_TIMES: Final = {
    "duration": ("duration_s", "the whole plan"),
    "soak": ("soak_s", "the part of the plan at constant temperature"),
    "motion": ("motion_s", "the part of the plan in which the temperature changes"),
}
# Quantities that have a "mean of max".
_OVER_RATE: Final = ("scale_factor", "gyro_scale_factor")


def dataset_of(
    job: Sweep, points: Points, results: tuple[PointResult, ...], identity: dict[str, Any]
) -> "xarray.Dataset":
    """The results: dimensions are the axes of a grid, or `point` for drawn points; every variable has its unit.

    Requirements give `<name>_<statistic>` (1σ; NaN where there is no result or nothing can be observed) and
    `<name>_verdict`; `failure` says why a point has no result.
    """
    import xarray

    grid = job.file.samples is None
    names = [variable_name(axis.label) for axis in job.file.axis]
    dims = tuple(names) if grid else ("point",)
    shape = points.shape
    values = [points.values(i) for i in range(len(points))]
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    for k, (axis, name) in enumerate(zip(job.file.axis, names, strict=True)):
        of_axis = axis.listed() if grid else [row[k] for row in values]
        numbers = [axis.number_of(value) for value in of_axis]
        attributes = {"long_name": axis.label, "keys": ", ".join(axis.changes), "spacing": axis.spacing}
        if any(number is None for number in numbers):
            column: Any = np.array([str(value) for value in of_axis], dtype=object)
        else:
            column = np.array(numbers, dtype=float)
            attributes["units"] = axis.unit or "1"
        coordinates[name] = ((name,) if grid else ("point",), column, attributes)

    def add(name: str, column: list[Any], attributes: dict[str, str]) -> None:
        array = np.array(column, dtype=object if isinstance(column[0], str) else float)
        variables[name] = (dims, array.reshape(shape), attributes)

    tables = [{row.requirement: row for row in result.residuals} for result in results]
    taken: set[str] = set()
    for i, requirement in enumerate(job.base.requirement):
        name = variable_name(requirement.name)
        if name in taken:
            name = f"{name}_{i}"
        taken.add(name)
        unit, _ = UNIT_OF[requirement.quantity]
        for s, statistic in enumerate(STATISTICS):
            if requirement.quantity not in _OVER_RATE and statistic == "mean of max":
                continue
            column = [_number(t.get(i), s) for t in tables]
            what = f"{requirement.name}: {statistic} of the residual {requirement.quantity.replace('_', ' ')}, 1 sigma"
            decisive = "yes" if statistic == requirement.statistic else "no"
            attributes = {
                "units": unit,
                "long_name": what,
                "requirement": requirement.name,
                "statistic": statistic,
                "decisive": decisive,
                "verdict": f"{name}_verdict",
            }
            add(f"{name}_{variable_name(statistic)}", column, attributes)
        verdicts = [row.verdict if (row := t.get(i)) else "" for t in tables]
        what = f"{requirement.name}: verdict, if there is a target"
        add(f"{name}_verdict", verdicts, {"long_name": what})
    for name, (field, what) in _TIMES.items():
        column = [np.nan if r.failure else getattr(r, field) for r in results]
        add(name, column, {"units": "s", "long_name": what})
    add(
        "failure",
        [r.failure for r in results],
        {"long_name": "reason why the point has no result; empty if it has a result"},
    )
    if job.file.do == "optimise":
        add("convergence", [r.note for r in results], {"long_name": "report of the optimiser"})
        add("optimised_spec", [r.spec for r in results], {"long_name": "gradcal-spec/1 with the optimised plan"})
        before = [np.nan if r.before is None else r.before for r in results]
        add(
            "objective_before",
            before,
            {"long_name": "the objective of the plan in the spec before optimisation, in its unit"},
        )
    failed = sum(bool(r.failure) for r in results)
    attributes = {
        "format": "gradcal-sweep-results/1",
        "title": job.file.title or "",
        "status": f"complete: {len(results)} points, {failed} of them failed",
        "sweep": job.text,
        "base": to_toml(job.base),
        "identity": json.dumps(identity),
        "note": "residuals are predictions by the model of the base spec, as one standard deviation",
    }
    return xarray.Dataset(variables, coordinates, attributes)


def _number(row: Any, statistic: int) -> float:
    value = None if row is None else row.values[statistic]
    return np.nan if value is None else value


def variable_name(text: str) -> str:
    """A name that programs can use: letters, digits and underscores."""
    plain = re.sub(r"\W+", "_", text.strip()).strip("_")
    return plain if plain and not plain[0].isdigit() else f"v_{plain}"


def read_dataset(path: str | Path) -> "xarray.Dataset":
    """The results of a sweep as labelled arrays: residuals in the unit of their attributes (ppm, deg/h; 1σ) over the
    sweep's axes, verdicts, and the reason for every failed point. Errors: `ValueError` for another kind of file."""
    try:
        results = load_netcdf(path)
    except NetcdfError as error:
        raise ValueError(f"{path} is not a result file of a sweep: {error}") from None
    if results.attrs.get("format") != "gradcal-sweep-results/1":
        raise ValueError(f"{path} was not written by gradcal sweep, so it is not a result file")
    return results


def identity_in(path: Path) -> dict[str, Any] | None:
    """The identity of the sweep whose results are in a file; None for another kind of file."""
    try:
        return json.loads(read_dataset(path).attrs["identity"])
    except (ValueError, KeyError, OSError):
        return None
