"""`gradcal predict` and `gradcal limit`: the residuals of plans, what they depend on, and what no plan is below."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, NOT_AS_WISHED, Flag, Json, Plot, as_json, drawable, save_figure, strong
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.pages.numbers import percent
from gradcal_jax.tables.display import amount, columns
from gradcal_jax.units import time_text, times_text

if TYPE_CHECKING:
    from gradcal_jax.information.prediction import TwinRow
    from gradcal_jax.spec.spec_sections import Spec
    from gradcal_jax.tables.contracts import Prediction, RequirementRow

# Smaller changes, in per cent, are not shown.
_NOTHING = 5e-4


def predict(
    specs: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    json: Json = False,
    plot: Plot = None,
    monte_carlo: int | None = None,
    seed: int = 0,
    sensitivity: Flag = False,
) -> int:
    """For every requirement of a spec, predict the error that remains after the plan, before anyone books a chamber.

    If there are several specs, compare their plans: the durations, the remaining errors, and the error terms that limit
    each plan. For a single spec, the exit status is 1 if a target is missed or a requirement cannot be observed.

    Parameters
    ----------
    specs
        The spec file, or several spec files to compare their plans.
    json
        Print the prediction as gradcal-prediction/1 (for several specs, a list); with --monte-carlo, print the
        prediction and the simulated results in one object.
    plot
        Draw a figure into this file (.png, .svg, .pdf): the predicted errors of the spec as maps or curves, those of
        several specs as curves over rate or temperature, or the sensitivities as bars.
    monte_carlo
        Also simulate this number of calibrations, and compare them with the prediction.
    seed
        The seed of the simulated calibrations.
    sensitivity
        Print by how many per cent the predicted error changes if a figure of sensor, rig or plan increases by one per
        cent. For an optimised recipe, the changes are the same if the plan is optimised again for the new figure.
    """
    from gradcal_jax.recipe.recipe import spec_in

    if not specs:
        raise ValueError("name a spec file, or several to compare their plans")
    drawable(plot)
    plans = [(path.stem, spec_in(path)) for path in specs]
    if len(plans) > 1 and (sensitivity or monte_carlo is not None):
        raise ValueError("--sensitivity and --monte-carlo are for a single spec")
    use_float64()
    if sensitivity:
        return _sensitivity(plans[0][1], str(specs[0]), json=json, plot=plot)
    return (
        _compared(plans, json, plot)
        if len(plans) > 1
        else _predicted(plans[0][1], specs[0], json, plot, monte_carlo, seed)
    )


def _predicted(spec: "Spec", path: Path, json: bool, plot: Path | None, monte_carlo: int | None, seed: int) -> int:
    from gradcal_jax.information import prediction as predictions

    rows, limits = [], not json or bool(spec.sensor.uncertain_figures())
    prediction = predictions.predict(spec, limits=limits)
    if monte_carlo is not None:
        rows = predictions.monte_carlo(spec, monte_carlo, seed)
    if json and monte_carlo is not None:
        simulated = {"runs": monte_carlo, "seed": seed, "requirements": [row._asdict() for row in rows]}
        print(as_json({"prediction": prediction.model_dump(mode="json"), "monte_carlo": simulated}))
    elif json:
        print(prediction.model_dump_json(indent=2))
    else:
        print(prediction_text(prediction, str(path)))
        omitted = omitted_lines(spec)
        print("\n".join(["", *omitted])) if omitted else None
        if monte_carlo is not None:
            print(_simulated(rows, monte_carlo, seed))
    save_figure(lambda plots: plots.draw_prediction(spec), plot, quiet=json)
    met = all(row.verdict in (None, "met") for row in prediction.requirements)
    return DONE if met else NOT_AS_WISHED


def _compared(plans: "list[tuple[str, Spec]]", json: bool, plot: Path | None) -> int:
    from gradcal_jax.information import prediction as predictions

    predictions = [(name, predictions.predict(spec, limits=True)) for name, spec in plans]
    if json:
        print("[" + ",\n".join(prediction.model_dump_json(indent=2) for _, prediction in predictions) + "]")
    else:
        print(side_by_side(predictions))
    save_figure(lambda plots: plots.draw_comparison(plans), plot, quiet=json)
    return DONE


def _sensitivity(spec: "Spec", source: str, *, json: bool, plot: Path | None) -> int:
    from gradcal_jax.information.sensitivity import sensitivity

    known = sensitivity(spec)
    if json:
        rows = [row._asdict() for row in known.rows]
        print(as_json({"residuals": known.residuals, "percent_per_percent": rows}))
    else:
        print(strong(spec.title or source))
        for name, (value, unit) in known.residuals.items():
            print(f"\n{name}: {amount(value, unit)}; its change if one of these figures increases by one per cent:")
            shown = [row for row in known.rows if row.requirement == name and abs(row.percent) >= _NOTHING]
            print(columns([(row.figure, f"{row.percent:+.3f} %") for row in shown], right=(1,)))
    save_figure(lambda plots: plots.draw_sensitivities(known), plot, quiet=json)
    return DONE


def _fixture(prediction: "Prediction") -> list[str]:
    """The places of a fixture."""
    names = [row.name for row in prediction.requirements]
    rows = [("place", *names)] if names else []
    if names:
        rows += [(of.name, *(amount(of.values.get(n), "").strip() for n in names)) for of in prediction.places]
    units = ", ".join(f"{row.name}: {row.unit}" for row in prediction.requirements)
    return [
        f"{len(prediction.places)} IMUs at once",
        *([columns(rows, indent="", right=tuple(range(1, len(names) + 1))), units] if names else []),
        f"all figures below are for the worst place: {prediction.place}",
    ]


def prediction_text(prediction: "Prediction", name: str) -> str:
    """A prediction as text: ppm, deg/h, hours."""
    from gradcal_jax.pages.coefficients import coefficient_table, parameters
    from gradcal_jax.tables.contracts import requirement_table

    times = times_text(prediction.duration_s, prediction.soak_s, prediction.motion_s)
    lines = [strong(prediction.title or name), times, ""]
    if prediction.places:
        lines[-1:] = [*_fixture(prediction), ""]
    if prediction.requirements:
        several = len({row.axis for row in prediction.requirements} & {"x", "y", "z"}) > 1
        lines.append(columns(requirement_table(prediction.requirements), indent=""))
        lines += [sentence for row in prediction.requirements for sentence in _judged(row, several)]
    else:
        lines.append("the spec has no [[requirement]]; the parameters' standard deviations are:")
    table, right = coefficient_table(parameters(prediction, None, {}))
    lines += ["", columns(table, indent="", right=right)]
    lines += [f"note: {warning}" for warning in prediction.warnings]
    return "\n".join(lines)


def omitted_lines(spec: "Spec") -> list[str]:
    """Error terms that are absent from the file, with the typical figures that count for them. Empty: none."""
    from gradcal_jax.spec.absent import (
        EARTH,
        EARTH_IS_UNKNOWN,
        absent_terms,
        attitude_sentences,
        branch_sentences,
        sensor_grade,
        table_grade,
    )

    absent, of_branches = absent_terms(spec), [*branch_sentences(spec), *attitude_sentences(spec)]
    if not absent:
        return of_branches
    sensor, table = sensor_grade(spec.sensor), table_grade(spec)
    lines = [
        "these terms are not in the file, so figures typical of the class count:",
        columns([(term.key, term.typical) for term in absent]),
        f"  class of the sensor: {sensor.name} grade ({sensor.like}), from {sensor.reason}",
        f"  class of the table: {table.name} ({table.like}), from {table.reason}",
        "enter your own figures in the file; 0 (or an empty list) means that there is no such error. Sources of "
        "the figures: gradcal check --json",
    ]
    return lines + [EARTH_IS_UNKNOWN] * any(term.key == EARTH for term in absent) * spec.is_one_axis + of_branches


def side_by_side(predictions: "list[tuple[str, Prediction]]") -> str:
    """A table of plans, one row for each requirement."""
    rows: list[tuple[str, ...]] = [("plan", "in all", "soak", "motion", "requirement", "residual (1σ)", "limited by")]
    for name, prediction in predictions:
        times = (time_text(prediction.duration_s), time_text(prediction.soak_s), time_text(prediction.motion_s))
        first = (name, *times)
        for row in prediction.requirements or ():
            axis = f", axis {row.axis}" if len({r.axis for r in prediction.requirements}) > 1 else ""
            left = amount(row.judged, row.unit)
            left += "" if row.own is None else f" (own noise {amount(row.own, row.unit)})"
            rows.append((*first, f"{row.name}{axis} ({row.statistic})", left, row.limited_by or ""))
            first = ("", "", "", "")
        if not prediction.requirements:
            rows.append((*first, "none", "", ""))
    return columns(rows, indent="")


def _named(row: "RequirementRow | TwinRow", several: bool) -> str:
    return f"{row.name}, axis {row.axis}" if several else row.name


def _judged(row: "RequirementRow", several: bool) -> list[str]:
    """The errors that limit a requirement, its decision rule, and the risks."""
    name = _named(row, several)
    lines = [f"{name}: limited by {row.limited_by}"] if row.limited_by else []
    lines += [another_run_line(row, name)] if row.another_run is not None else []
    lines += own_noise_lines(row, name)
    if row.rule and row.verdict != "unobservable":
        lines.append(f"{name}: {row.verdict} by {row.rule}")
        if row.specific_risk is not None:
            lines.append(
                f"  probability that the error at the worst point exceeds the target: {percent(row.specific_risk)}"
            )
    return lines


def another_run_line(row: "RequirementRow", name: str) -> str:
    """The bias of another power-on, which the verdict counts."""
    this = row.decisive if row.with_typical is None else row.with_typical
    return (
        f"{name}: {amount(this, row.unit)} in this run, {amount(row.another_run, row.unit)} after another power-on. "
        'The verdict counts the latter; with of = "this run" the turn-on bias does not count'
    )


def own_noise_lines(row: "RequirementRow", name: str) -> list[str]:
    """The noise that no calibration corrects, next to the residual; with several missions, a row for each."""
    if row.own is None or row.own_sources is None:
        return []
    parts = ", ".join(f"{source} {value:.3g}" for source, value in row.own_sources.items() if value >= 0.05 * row.own)
    in_all = "" if row.judged is None else f"{amount(math.hypot(row.judged, row.own), row.unit)} in all, including "
    lines = [f"{name}: {in_all}{amount(row.own, row.unit)} of noise that no calibration corrects ({parts})"]
    if row.missions is not None and len(row.missions) > 1:
        head = ("mission", "weight", "after", "calibration leaves", "own noise")
        rows = [
            (m.file, f"{m.weight:g}", time_text(m.after_s), amount(m.left, row.unit), amount(m.own, row.unit))
            for m in row.missions
        ]
        lines.append(columns([head, *rows]))
    return lines


def _simulated(rows: "list[TwinRow]", runs: int, seed: int) -> str:
    table: list[tuple[str, ...]] = [("simulated", "predicted", f"of {runs} runs, seed {seed}")]
    several = len({row.axis for row in rows}) > 1
    for row in rows:
        table.append((_named(row, several), amount(row.predicted, row.unit), amount(row.simulated, row.unit)))
    return "\n".join(["", columns(table, indent="")])


def limit(spec: Path, /, *, json: Json = False) -> int:
    """Prove a lower limit for the error of all plans on this rig and of this duration, and print the efficiency of this
    plan.

    The proof ignores some limits of the rig; the command lists these limits. Therefore it is possible that no real plan
    reaches the lower limit; no plan can be below it. An efficiency of 67 % means that the error of every
    plan is at least 0.67 times the error of this plan. For scale factors and misalignments of an IMU's gyros, the
    command also proves a second limit, for all plans in which the same axes turn at the same times as in this plan.

    Parameters
    ----------
    spec
        The spec file, or a recipe. The limit is for all plans that differ only in the parts that [design] allows to
        change; for an IMU, for all plans of the same duration at the same temperatures.
    json
        Print the limits for other programs.
    """
    from gradcal_jax.recipe.recipe import spec_in

    specification = spec_in(spec)
    use_float64()
    from gradcal_jax.design.plan_limit import limit as limit_of

    rows = limit_of(specification)
    if json:
        print(as_json([row._asdict() for row in rows]))
        return DONE
    turning = any(row.with_turns is not None for row in rows)
    between = "limit for these turns" if turning else "relaxed problem reaches"
    table = [("requirement", "no plan leaves less than", between, "this plan leaves", "efficiency")]
    for row in rows:
        share = "" if row.efficiency is None else f"{row.efficiency:.0%}"
        second = row.with_turns if turning else row.reached
        bounds = amount(row.certified, row.unit), "" if second is None else amount(second, row.unit)
        table.append((f"{row.name} ({row.statistic})", *bounds, amount(row.value, row.unit), share))
    print(strong(specification.title or str(spec)))
    print(columns(table, indent=""))
    if turning:
        print(
            "limit for these turns: no plan in which the same axes turn at the same times as in this plan, by any "
            "angles and at any rates, leaves less; if a requirement has this limit, its efficiency refers to this limit"
        )
    for row in rows:
        if row.judged is not None and row.judged != row.value:
            print(
                f"{row.name}: if the omitted terms count with typical figures, no plan leaves less than "
                f"{amount(row.counted, row.unit)}, and this plan leaves {amount(row.judged, row.unit)}"
            )
    for kept in dict.fromkeys(row.kept for row in rows if row.kept):
        print("the limit is for all plans that keep: " + "; ".join(kept))
    for relaxed in dict.fromkeys(row.relaxed for row in rows):
        names = ", ".join(row.name for row in rows if row.relaxed == relaxed)
        of = "" if all(row.relaxed == relaxed for row in rows) else f" for {names}"
        print(f"the proof{of} ignores or relaxes: " + "; ".join(relaxed))
    return DONE
