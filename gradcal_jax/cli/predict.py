"""`gradcal predict` and `gradcal limit`: the residuals of plans before they are run, and what no plan is below."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gradcal_jax.cli.output import Json, Plot, Switch, drawable, show, strong
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.units import time_text, times_text

if TYPE_CHECKING:
    from gradcal_jax.spec.contracts import Prediction
    from gradcal_jax.spec.spec_sections import Spec


def predict(
    specs: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    parameters: Switch = False,
    budget: Switch = False,
    json: Json = False,
    plot: Plot = None,
) -> int:
    """For every requirement of a spec, predict the error that remains after the plan, before anyone books a chamber.

    If there are several specs, compare their plans: durations, remaining errors, and what limits each plan. The exit
    status is 1 if a target is missed or a requirement cannot be observed.

    Parameters
    ----------
    specs
        The spec file (or a recipe), or several of them to compare their plans.
    parameters
        Also print the standard deviation of each coefficient.
    budget
        Also print the share of each error in every requirement, and the errors that are not in the file.
    json
        Print the prediction as gradcal-prediction/1 (for several specs, a list).
    plot
        Draw the predicted errors into this file (.png, .svg, .pdf).
    """
    from gradcal_jax.recipe.recipe import spec_in

    if not specs:
        raise ValueError("name a spec file, or several to compare their plans")
    drawable(plot)
    plans = [(path.stem, spec_in(path)) for path in specs]
    use_float64()
    from gradcal_jax.information.prediction import predict as work

    predictions = [(name, work(spec, limits=True)) for name, spec in plans]
    records = [one.model_dump(mode="json") for _, one in predictions]
    if len(plans) > 1:
        lines = [side_by_side(predictions)]
    else:
        (_, spec), (_, prediction) = plans[0], predictions[0]
        lines = [prediction_text(prediction, str(specs[0]))]
        lines += ["", parameter_text(prediction)] if parameters else []
        lines += [budget_text(spec)] if budget else []
    if plot is not None:
        from gradcal_jax.plots import draw_comparison, save

        save(draw_comparison(plans), plot)
        lines.append(f"wrote {plot}")
    verdicts = {row.verdict for _, one in predictions for row in one.requirements}
    return show(
        "\n".join(lines), records if len(plans) > 1 else records[0], json=json, wished=verdicts <= {None, "met"}
    )


def prediction_text(prediction: "Prediction", name: str) -> str:
    """A prediction in about ten lines: requirement, residual (1σ), target, verdict, and what limits it."""
    from gradcal_jax.spec.contracts import outcomes

    lines = [strong(prediction.title or name)]
    lines += [times_text(prediction.duration_s, prediction.soak_s, prediction.motion_s), ""]
    if prediction.requirements:
        lines.append(outcomes(prediction.requirements).text())
    else:
        lines.append("state a [[requirement]] in the spec, or print the coefficients with --parameters")
    if prediction.omitted:
        count = len(prediction.omitted)
        lines.append(f"{count} errors are not in the file and count as is typical of the class: see --budget")
    return "\n".join([*lines, *(f"note: {warning}" for warning in prediction.warnings)])


def parameter_text(prediction: "Prediction") -> str:
    """The standard deviation of every coefficient."""
    from gradcal_jax.pages.tables import coefficients

    return coefficients(prediction, None).text()


def budget_text(spec: "Spec") -> str:
    """The share of every error in the variance of each requirement, and the errors that are not in the file."""
    from gradcal_jax.information.prediction import counted_shares
    from gradcal_jax.spec.absent import absent_terms
    from gradcal_jax.tables.table import Column, Table

    parts: list[str] = []
    for name, shares in counted_shares(spec).items():
        rows = [(source, 100.0 * share) for source, share in shares.items() if share >= 5e-4]
        rows.sort(key=lambda row: -row[1])
        parts.append("\n" + Table.of([name, Column("share of the variance", "%", 3)], rows).text())
    omitted = [(term.key, term.typical) for term in absent_terms(spec)]
    if omitted:
        parts.append("\n" + Table.of(["not in the file", "typical figure"], omitted).text())
        parts.append("enter your own figures; 0 (or an empty list) means that there is no such error")
    return "\n".join(parts)


def side_by_side(predictions: "list[tuple[str, Prediction]]") -> str:
    """A table of plans, one row for each requirement."""
    from gradcal_jax.tables.display import amount
    from gradcal_jax.tables.table import Table

    rows: list[tuple[str, ...]] = []
    for name, prediction in predictions:
        first = (name, time_text(prediction.duration_s))
        for row in prediction.requirements:
            what = f"{row.name}, {row.axis}"
            rows.append((*first, what, row.statistic, amount(row.judged, row.unit), row.limited_by or ""))
            first = ("", "")
    return Table.of(["plan", "in all", "requirement", "statistic", "residual 1σ", "limited by"], rows).text()


def limit(spec: Path, /, *, json: Json = False) -> int:
    """Prove a lower limit for the error of all plans on this rig and of this duration, and print the efficiency of this
    plan.

    The proof ignores some limits of the rig; the command lists these limits. Therefore it is possible that no real plan
    reaches the lower limit; no plan can be below it. An efficiency of 67 % means that the error of every plan is at
    least 0.67 times the error of this plan.

    Parameters
    ----------
    spec
        The spec file, or a recipe. The limit is for all plans that differ only in the parts that [design] allows to
        change; for an IMU, for all plans of the same duration at the same temperatures.
    json
        Print the limits for other programs.
    """
    from gradcal_jax.recipe.recipe import spec_in
    from gradcal_jax.tables.display import amount
    from gradcal_jax.tables.table import Table

    specification = spec_in(spec)
    use_float64()
    from gradcal_jax.design.plan_limit import limit as limit_of

    rows = limit_of(specification)
    cells: list[tuple[str, ...]] = []
    for row in rows:
        share = "" if row.efficiency is None else f"{row.efficiency:.0%}"
        values = amount(row.certified, row.unit), amount(row.value, row.unit)
        cells.append((f"{row.name} ({row.statistic})", *values, share))
    lines = [strong(specification.title or str(spec))]
    lines.append(Table.of(["requirement", "no plan leaves less than", "this plan leaves", "efficiency"], cells).text())
    for kept in dict.fromkeys(row.kept for row in rows if row.kept):
        lines.append("the limit is for all plans that keep: " + "; ".join(kept))
    ways = dict.fromkeys(row.relaxed for row in rows)
    for relaxed in ways:
        names = ", ".join(row.name for row in rows if row.relaxed == relaxed)
        of = f" for {names}" if len(ways) > 1 else ""
        lines.append(f"the proof{of} ignores or relaxes: " + "; ".join(relaxed))
    return show("\n".join(lines), [row._asdict() for row in rows], json=json)
