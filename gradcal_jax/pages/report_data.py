"""All numbers of a page, from recipe, run and calibration, by the functions behind the commands."""

from typing import Any, NamedTuple

from gradcal_jax import api
from gradcal_jax.api.ieee_terms import IeeeTerm, standard_terms
from gradcal_jax.display import summary
from gradcal_jax.pages.applying import ExampleFact, ExportFact, examples_of, exports_of
from gradcal_jax.pages.coefficients import ParameterFact, agreement, hidden_values, parameters, predicted_deviations
from gradcal_jax.pages.provenance import assumed_noise, provenance_rows
from gradcal_jax.pages.requirements import MapFact, RequirementFact, hidden_by_structure, requirements_of
from gradcal_jax.pages.run_history import RunHistory, history_of
from gradcal_jax.pages.sources import Sources
from gradcal_jax.pages.unit import assumed_of_unit, unit_requirements, versions_row


class AxisFact(NamedTuple):
    """The calibration of one channel ("gyro x")."""

    axis: str
    terms: tuple[IeeeTerm, ...]
    valid_temperature: tuple[str, str]
    valid_rate: tuple[str, str]


class ReportData(NamedTuple):
    """All numbers of a page. `before_is`: the meaning of "before"; empty without it. `fit`: tests of the fit, each with
    its name, χ², degrees of freedom and chance; `contradicted`: those that fail; `agreement`: χ² of the estimate
    against a simulation's truth, its degrees, its chance."""

    title: str
    simulated: bool
    before_is: str
    requirements: tuple[RequirementFact, ...]
    parameters: tuple[ParameterFact, ...]
    axes: tuple[AxisFact, ...]
    unobservable: tuple[str, ...]
    contradicted: tuple[str, ...]
    fit: tuple[tuple[str, float, int, float], ...]
    agreement: tuple[float, int, float] | None
    examples: tuple[ExampleFact, ...]
    exports: tuple[ExportFact, ...]
    assumed: tuple[tuple[str, str], ...]
    history: RunHistory | None
    provenance: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    maps: tuple[MapFact, ...]

    __repr__ = summary

    @property
    def verdict(self) -> str:
        """The verdict of all requirements together ("met", "missed", "not covered", "unobservable", "not valid"); empty
        where none has a target."""
        verdicts = {row.verdict for row in self.requirements}
        for word in ("not valid", "unobservable", "not covered", "missed", "met"):
            if word in verdicts:
                return word
        return ""


def report_data_of(sources: Sources) -> ReportData:
    """Compute the data of a page. Raises `ValueError` for a run that never began."""
    recipe, calibration, unit = sources.recipe, sources.calibration, sources.unit
    history = None if sources.run is None else history_of(sources.run)
    prediction = None if unit is None else api.predict(unit)
    if prediction is None:
        before_is, requirements, maps = requirements_of(sources)
    else:
        before_is, requirements, maps = "", unit_requirements(prediction, calibration), []
    notes = [*sources.notes]
    if calibration is not None and calibration.lacks is not None:
        notes.append(calibration.lacks)
    for planned in (prediction, None if recipe is None else recipe.prediction):
        notes += [] if planned is None else [*(row.sentence for row in planned.notices), *planned.warnings]
    notes += [] if recipe is None else recipe.notes
    if calibration is not None and calibration.unobservable:
        notes.append(f"not observed by the data: {', '.join(calibration.unobservable)}")
    notes += hidden_by_structure(requirements, maps)
    hidden = hidden_values(sources.hidden_truth, calibration)
    titles = (source.title for source in (recipe, unit, calibration) if source is not None and source.title)
    return ReportData(
        title=next(titles, "Calibration"),
        simulated=any(source is not None and source.simulated for source in (history, calibration)),
        before_is=before_is,
        requirements=tuple(requirements),
        parameters=tuple(parameters(predicted_deviations(recipe, prediction), calibration, hidden)),
        axes=()
        if calibration is None
        else tuple(
            AxisFact(
                channel.label,
                tuple(standard_terms(calibration, channel)),
                (str(channel.valid_temperature[0]), str(channel.valid_temperature[1])),
                (str(channel.valid_rate[0]), str(channel.valid_rate[1])),
            )
            for channel in calibration.channel
        ),
        unobservable=() if calibration is None else calibration.unobservable,
        contradicted=() if calibration is None else calibration.contradicted,
        fit=()
        if calibration is None
        else tuple((t.name.replace("_", " "), t.statistic, t.degrees, t.chance) for t in calibration.fit),
        agreement=None if calibration is None else agreement(calibration.values(), calibration.covariance, hidden),
        examples=() if calibration is None else tuple(examples_of(calibration)),
        exports=() if calibration is None else tuple(exports_of(calibration, sources.calibration_name)),
        assumed=tuple(assumed_noise(recipe, calibration) if unit is None else assumed_of_unit(unit)),
        history=history,
        provenance=(*provenance_rows(sources), *(() if unit is None else (versions_row(),))),
        notes=tuple(dict.fromkeys(notes)),
        maps=tuple(maps),
    )


def as_tables(data: ReportData) -> dict[str, Any]:
    """The report as plain numbers and texts for other programs; maps and tracks are left out."""
    done = None
    if (history := data.history) is not None:
        done = history._asdict()
        for name in ("chamber_s", "chamber_c", "rates"):
            del done[name]
        # As the last keys, as in earlier versions.
        done |= {name: [row._asdict() for row in done.pop(name)] for name in ("waited", "devices")}
    return {
        "title": data.title,
        "simulated": data.simulated,
        "verdict": data.verdict or None,
        "before_is": data.before_is or None,
        "requirements": [row._asdict() for row in data.requirements],
        "parameters": [row._asdict() for row in data.parameters],
        "axes": [row._asdict() | {"terms": [term._asdict() for term in row.terms]} for row in data.axes],
        "unobservable": list(data.unobservable),
        "contradicted": list(data.contradicted),
        "fit": [dict(zip(("test", "statistic", "degrees", "chance"), row, strict=True)) for row in data.fit],
        "agreement": data.agreement,
        "examples": [row._asdict() for row in data.examples],
        "exports": [row._asdict() for row in data.exports],
        "assumed": dict(data.assumed),
        "run": done,
        "provenance": dict(data.provenance),
        "notes": list(data.notes),
    }
