"""All numbers of a page, from recipe, run and calibration, by the functions behind the commands."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from gradcal_jax.api.ieee_terms import IeeeTerm, standard_terms
from gradcal_jax.files.calibration import AxisCalibration
from gradcal_jax.files.unit_calibration import UnitCalibration
from gradcal_jax.pages.applying import ExampleFact, ExportFact, example_of, exports_of
from gradcal_jax.pages.coefficients import ParameterFact, agreement, hidden_of, parameters
from gradcal_jax.pages.provenance import assumed_noise, provenance_rows
from gradcal_jax.pages.requirements import MapFact, RequirementFact, hidden_by_structure, requirements_of
from gradcal_jax.pages.run_history import RunHistory, history_of
from gradcal_jax.pages.sources import Sources


class AxisFact(NamedTuple):
    """The calibration of one axis. `fit`: tests of the fit, each with its name, χ², degrees of freedom and chance;
    `contradicted`: those that fail;
    `agreement`: χ² of the estimate against a simulation's truth, its degrees, its chance."""

    axis: str
    terms: tuple[IeeeTerm, ...]
    valid_temperature: tuple[str, str]
    valid_rate: tuple[str, str]
    unobservable: tuple[str, ...]
    contradicted: tuple[str, ...]
    fit: tuple[tuple[str, float, int, float], ...]
    agreement: tuple[float, int, float] | None


class ReportData(NamedTuple):
    """All numbers of a page. `before_is`: the meaning of "before"; empty without it."""

    title: str
    simulated: bool
    before_is: str
    requirements: tuple[RequirementFact, ...]
    parameters: tuple[ParameterFact, ...]
    axes: tuple[AxisFact, ...]
    examples: tuple[ExampleFact, ...]
    exports: tuple[ExportFact, ...]
    assumed: tuple[tuple[str, str], ...]
    history: RunHistory | None
    provenance: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    maps: tuple[MapFact, ...]

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
    recipe, calibration = sources.recipe, sources.calibration
    history = None if sources.run is None else history_of(sources.run)
    before_is, requirements, maps = requirements_of(sources)
    axes = () if calibration is None else tuple(_axis(axis, sources.hidden_truth) for axis in calibration.axis)
    notes = [*sources.notes]
    if calibration is not None and calibration.lacks is not None:
        notes.append(calibration.lacks)
    if recipe is not None:
        notes += [*recipe.notes, *(row.sentence for row in recipe.prediction.notices), *recipe.prediction.warnings]
    notes += [
        f"axis {axis.axis}: the data say nothing of {', '.join(axis.unobservable)}"
        for axis in axes
        if axis.unobservable
    ]
    notes += hidden_by_structure(requirements, maps)
    simulated = any(source is not None and source.simulated for source in (history, calibration))
    title = (recipe.title if recipe is not None else None) or (calibration.title if calibration is not None else None)
    return ReportData(
        title=title or "Calibration",
        simulated=simulated,
        before_is=before_is,
        requirements=tuple(requirements),
        parameters=tuple(parameters(recipe, calibration, sources.hidden_truth)),
        axes=axes,
        examples=() if calibration is None else tuple(example_of(axis) for axis in calibration.axis),
        exports=() if calibration is None else tuple(exports_of(calibration, sources.calibration_name)),
        assumed=tuple(assumed_noise(recipe, calibration)),
        history=history,
        provenance=tuple(provenance_rows(sources)),
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
        "examples": [row._asdict() for row in data.examples],
        "exports": [row._asdict() for row in data.exports],
        "assumed": dict(data.assumed),
        "run": done,
        "provenance": dict(data.provenance),
        "notes": list(data.notes),
    }


def axis_fact(
    of: AxisCalibration | UnitCalibration, name: str, terms: Sequence[IeeeTerm], agreed: tuple[float, int, float] | None
) -> AxisFact:
    """The calibration of an axis, or of a whole unit."""
    return AxisFact(
        name,
        tuple(terms),
        (str(of.valid_temperature[0]), str(of.valid_temperature[1])),
        (str(of.valid_rate[0]), str(of.valid_rate[1])),
        of.unobservable,
        of.contradicted,
        tuple((t.name.replace("_", " "), t.statistic, t.degrees, t.chance) for t in of.fit),
        agreed,
    )


def _axis(axis: AxisCalibration, truth: dict[str, Any] | None) -> AxisFact:
    known = None if axis.unobservable else axis.covariance
    return axis_fact(axis, axis.name, standard_terms(axis), agreement(axis.values(), known, hidden_of(axis, truth)))
