"""`gradcal predict` and `gradcal compare`: what plans leave, by requirement."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from gradcal_jax import units
from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Json, Plot, as_json, drawable, save_figure
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import amount, columns
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.files import Prediction
    from gradcal_jax.files.contracts import RequirementRow


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(predict)
    app.command(compare)


def predict(
    spec: Path,
    /,
    *,
    json: Json = False,
    plot: Plot = None,
    monte_carlo: int | None = None,
    seed: int = 0,
) -> int:
    """Say what a spec's plan will leave: the residual of every requirement, before anyone books a chamber.

    The exit status is 1 where a target is missed or a requirement cannot be observed.

    Parameters
    ----------
    spec
        The spec file.
    json
        Print the prediction as gradcal-prediction/1; with --monte-carlo, both under their names.
    plot
        Draw the residual maps into this file (.png, .svg, .pdf).
    monte_carlo
        Simulate this many calibrations, too, and compare them with the prediction.
    seed
        Of the simulated calibrations.
    """
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.files.recipe import any_spec_in
    from gradcal_jax.files.unit_spec import UnitSpec

    drawable(plot)
    found = any_spec_in(spec)
    if isinstance(found, UnitSpec) and monte_carlo is not None:
        raise ValueError("--monte-carlo simulates one gyro axis, not yet a whole unit: leave it out")
    use_float64()
    from gradcal_jax import api

    prediction = api.predict(found, limits=not json)
    rows, tests = ((), {})
    if monte_carlo is not None and not isinstance(found, UnitSpec):
        rows, tests = api.monte_carlo(found, monte_carlo, seed)
    if json and monte_carlo is not None:
        simulated = {"runs": monte_carlo, "seed": seed, "requirements": [row._asdict() for row in rows]}
        simulated["covariance"] = {
            axis: test._asdict() | {"consistent": test.consistent} for axis, test in tests.items()
        }
        print(as_json({"prediction": prediction.model_dump(mode="json"), "monte_carlo": simulated}))
    elif json:
        print(prediction.model_dump_json(indent=2))
    else:
        print(text(prediction, str(spec)))
        if monte_carlo is not None:
            print(_simulated(rows, tests, monte_carlo, seed))
    if plot is not None:
        from gradcal_jax.plots import draw_prediction, draw_unit

        figure = draw_unit(found) if isinstance(found, UnitSpec) else draw_prediction(found)
        save_figure(figure, plot, quiet=json)
    met = all(row.verdict in (None, "met") for row in prediction.requirements)
    return DONE if met and all(test.consistent for test in tests.values()) else NOT_AS_WISHED


def compare(
    specs: Annotated[tuple[Path, ...], Parameter(negative="")], /, *, json: Json = False, plot: Plot = None
) -> int:
    """Put plans side by side: hours, residuals, and what each is limited by.

    Parameters
    ----------
    specs
        The spec files.
    json
        Print one prediction (gradcal-prediction/1) for each spec, as a list.
    plot
        Draw the plans' residuals against rate or temperature into this file.
    """
    if not specs:
        raise ValueError("compare what? Name two or more spec files")
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.files.recipe import any_spec_in
    from gradcal_jax.files.unit_spec import UnitSpec

    drawable(plot)
    found = [(path.stem, any_spec_in(path)) for path in specs]
    of_axes = [(name, spec) for name, spec in found if not isinstance(spec, UnitSpec)]
    if plot is not None and len(of_axes) < len(found):
        raise ValueError(
            "--plot compares plans of one gyro axis; draw a unit's plan by: gradcal predict SPEC --plot FILE"
        )
    use_float64()
    from gradcal_jax import api

    predictions = [(name, api.predict(spec, limits=True)) for name, spec in found]
    if json:
        print("[" + ",\n".join(prediction.model_dump_json(indent=2) for _, prediction in predictions) + "]")
    else:
        print(side_by_side(predictions))
    if plot is not None:
        from gradcal_jax.plots import draw_comparison

        save_figure(draw_comparison(of_axes), plot, quiet=json)
    return DONE


def text(prediction: "Prediction", name: str) -> str:
    """A prediction as people read it: ppm, deg/h, hours."""
    lines = [strong(prediction.title or name), _times(prediction), ""]
    if prediction.requirements:
        several = len({row.axis for row in prediction.requirements} & {"x", "y", "z"}) > 1
        head = ("requirement", "quantity", "statistic", "residual (1σ)", "target", "verdict", "limited by")
        lines.append(columns([head, *(_row(row, several) for row in prediction.requirements)], indent=""))
    else:
        lines.append("the spec has no [[requirement]]; the parameters' standard deviations are:")
    if any(row.axis == "unit" for row in prediction.parameters):
        from gradcal_jax.pages.unit import parameter_table

        lines += ["", columns(parameter_table(prediction), indent="", right=(1, 2, 3))]
    else:
        lines += ["", columns(_parameters(prediction), indent="", right=(1,))]
    lines += [f"note: {warning}" for warning in prediction.warnings]
    return "\n".join(lines)


def side_by_side(predictions: "list[tuple[str, Prediction]]") -> str:
    """Plans as rows, requirements below one another."""
    rows: list[tuple[str, ...]] = [("plan", "in all", "soak", "motion", "requirement", "residual (1σ)", "limited by")]
    for name, prediction in predictions:
        times = (time_text(prediction.duration_s), time_text(prediction.soak_s), time_text(prediction.motion_s))
        first = (name, *times)
        for row in prediction.requirements or ():
            axis = f", axis {row.axis}" if len({r.axis for r in prediction.requirements}) > 1 else ""
            left = amount(row.decisive, row.unit)
            rows.append((*first, f"{row.name}{axis} ({row.statistic})", left, row.limited_by or ""))
            first = ("", "", "", "")
        if not prediction.requirements:
            rows.append((*first, "none", "", ""))
    return columns(rows, indent="")


def _times(prediction: "Prediction") -> str:
    parts = (prediction.duration_s, prediction.soak_s, prediction.motion_s)
    return "{} in all: soak {}, motion {}".format(*(time_text(part) for part in parts))


def _row(row: "RequirementRow", several: bool) -> tuple[str, ...]:
    name = f"{row.name}, axis {row.axis}" if several else row.name
    left, target = amount(row.decisive, row.unit), "" if row.target is None else amount(row.target, row.unit)
    verdict, limited_by = row.verdict or "", row.limited_by or ""
    return (name, row.quantity.replace("_", " "), row.statistic, left, target, verdict, limited_by)


_SHOWN = {
    "rad/s": ("deg/h", units.DEG_PER_H),
    "1": ("ppm", units.PPM),
    "rad/K": ("deg/h/(K/min)", units.DEG_PER_H / 60.0),
}


def _parameters(prediction: "Prediction") -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("parameter", "1σ", "unit")]
    several = len({row.axis for row in prediction.parameters}) > 1
    for row in prediction.parameters:
        unit, factor = _SHOWN.get(row.unit, (row.unit, 1.0))
        name = f"{row.name}, axis {row.axis}" if several else row.name
        rows.append((name, "not observable" if row.std is None else f"{row.std * factor:.4g}", unit))
    return rows


def _simulated(rows, tests, runs: int, seed: int) -> str:
    table: list[tuple[str, ...]] = [("simulated", "predicted", f"of {runs} runs")]
    several = len(tests) > 1
    for row in rows:
        name = f"{row.name}, axis {row.axis}" if several else row.name
        table.append((name, amount(row.predicted, row.unit), amount(row.simulated, row.unit)))
    lines = ["", columns(table, indent="")]
    for axis, test in tests.items():
        where = f" (axis {axis})" if several else ""
        verdict = "is consistent" if test.consistent else "is NOT consistent"
        lines.append(
            f"the covariance of {runs} simulated runs (seed {seed}) {verdict} with the prediction{where}: "
            f"likelihood ratio {test.statistic:.1f}, 99.9 % range {test.low:.1f} to {test.high:.1f}"
        )
    return "\n".join(lines)
