"""All numbers of a page, from recipe, run and calibration, by the functions behind the commands; and how a calibration
is applied."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration import Calibration
from gradcal_jax.calibration.correction import correct
from gradcal_jax.calibration.exports import FORMATS, export
from gradcal_jax.calibration.path_losses import Loss
from gradcal_jax.estimation.calibrations import IeeeTerm, standard_terms
from gradcal_jax.pages.coefficients import ParameterFact, agreement, hidden_values, parameters
from gradcal_jax.pages.numbers import figures
from gradcal_jax.pages.requirements import MapFact, RequirementFact, requirements_of
from gradcal_jax.pages.run_history import RunHistory, history_of
from gradcal_jax.pages.sources import Sources, assumptions, provenance_rows
from gradcal_jax.tables.display import summary
from gradcal_jax.units import DEG_PER_S

_ENDINGS: Final = {
    "ardupilot": "parm",
    "px4": "params",
    "kalibr": "yaml",
    "matrices": "yaml",
    "c-header": "h",
    "csv": "csv",
}
_AT_ONE_TEMPERATURE: Final = ("kalibr", "matrices")


class ExampleFact(NamedTuple):
    """The correction of one reading of a channel, in `unit`."""

    channel: str
    temperature_c: float
    measured: float
    corrected: float
    unit: str


class ExportFact(NamedTuple):
    """The export to another program: command and losses. `largest`: of each kind of loss that of the channel with the
    largest one."""

    target: str
    command: str
    losses: tuple[str, ...]
    largest: tuple[str, ...] = ()


def examples_of(calibration: Calibration) -> list[ExampleFact]:
    """A reading of all channels at once: a third of the largest rate and half of gravity, at room temperature where
    that is covered."""
    at, readings = _room(calibration), dict[str, float]()
    for channel in calibration.channel:
        fastest = max(abs(float(end)) for end in channel.valid_rate) * DEG_PER_S
        readings[channel.input] = float(f"{fastest / 3.0:.1g}") / DEG_PER_S if channel.kind == "gyro" else 5.0
    done = correct(calibration.channel, {name: np.array([v]) for name, v in readings.items()}, np.array([at]))
    facts: list[ExampleFact] = []
    for channel in calibration.channel:
        unit, factor = ("deg/s", DEG_PER_S) if channel.kind == "gyro" else ("m/s²", 1.0)
        true = float(done[channel.input][0])
        facts.append(ExampleFact(channel.label, at, readings[channel.input] * factor, true * factor, unit))
    return facts


def exports_of(calibration: Calibration, name: str) -> list[ExportFact]:
    """Every export with its command and losses; those of one temperature at room temperature, where it is covered."""
    at = _room(calibration)
    facts: list[ExportFact] = []
    for target in (one for one in FORMATS if one != "template"):
        option = f' --temperature "{at:g} degC"' if target in _AT_ONE_TEMPERATURE else ""
        command = f"gradcal export {name} --format {target}{option} -o calibration.{_ENDINGS[target]}"
        try:
            done = export(calibration, target, temperature_c=at if option else None)
        except ValueError as error:
            refused = (f"not for this calibration: {error}",)
            facts.append(ExportFact(target, "", refused, refused))
            continue
        lost = [loss for loss in done.losses if loss.value > 0.0]
        texts = tuple(f"{x.channel}: {x.what}, up to {x.value:.4g} {x.unit}" for x in lost)
        facts.append(ExportFact(target, command, texts, tuple(_largest(lost))))
    return facts


def _largest(losses: Sequence[Loss]) -> Iterator[str]:
    """The largest loss of each kind, over the channels of a sensor and the axes of a misalignment or sensitivity."""
    kinds: dict[tuple[str, str, str], Loss] = {}
    for loss in losses:
        what = re.sub(r"(misalignment|g sensitivity) [xyz]\b", r"\1", loss.what)
        key = (loss.channel.split()[0], what, loss.unit)
        kinds[key] = max(kinds.get(key, loss), loss, key=lambda one: one.value)
    for (_, what, unit), loss in kinds.items():
        yield f"{what}, up to {figures(loss.value)} {unit} ({loss.channel})"


def _room(calibration: Calibration) -> float:
    cold, warm = (float(end) for end in calibration.valid_temperature)
    return 25.0 if cold <= 25.0 <= warm else 0.5 * (cold + warm)


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
    assumed: tuple[tuple[str, str], ...]
    history: RunHistory | None
    provenance: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    maps: tuple[MapFact, ...]
    axes: tuple[AxisFact, ...] = ()
    unobservable: tuple[str, ...] = ()
    contradicted: tuple[str, ...] = ()
    fit: tuple[tuple[str, float, int, float], ...] = ()
    agreement: tuple[float, int, float] | None = None
    examples: tuple[ExampleFact, ...] = ()
    exports: tuple[ExportFact, ...] = ()

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
    recipe, calibration = sources.recipe, sources.calibration
    history = None if sources.run is None else history_of(sources.run)
    prediction = None if sources.spec is None else sources.prediction
    left = requirements_of(sources)
    notes = [*sources.notes]
    if prediction is not None:
        notes += prediction.warnings
    notes += [] if recipe is None else recipe.notes
    if left.differing:
        notes.append(
            "the achieved maps use the covariance in the calibration file; the results in this file also include "
            "errors that are not in this covariance, such as the estimate of a model discrepancy: "
            f"{', '.join(left.differing)}"
        )
    hidden = hidden_values(sources.hidden_truth, calibration)
    own: dict[str, Any] = {} if calibration is None else _of_calibration(calibration, sources, hidden, history)
    if calibration is not None:
        notes += [] if calibration.lacks is None else [calibration.lacks]
        notes += [f"the data do not observe: {', '.join(calibration.unobservable)}"] * bool(calibration.unobservable)
    titles = (source.title for source in (recipe, sources.spec, calibration) if source is not None and source.title)
    return ReportData(
        title=next(titles, "Calibration"),
        simulated=any(source is not None and source.simulated for source in (history, calibration)),
        before_is=left.before_is,
        requirements=left.rows,
        parameters=tuple(parameters(prediction, calibration, hidden)),
        assumed=tuple(assumptions(sources.spec, calibration)),
        history=history,
        provenance=tuple(provenance_rows(sources)),
        notes=tuple(dict.fromkeys(notes)),
        maps=left.maps,
        **own,
    )


def _walked_before(sources: Sources, history: RunHistory | None) -> float:
    """Standard deviation (rad/s) of the gyros' random walk between power-on and the first data of a run."""
    spec = sources.spec
    gyro = None if spec is None else spec.sensor.gyro
    if history is None or spec is None or gyro is None or gyro.rate_random_walk is None:
        return 0.0
    begins = (segment.start for segment in getattr(spec.schedule, "segments", ()) if segment.used)
    before = next(begins, 0.0) + sum(step.waited_s for step in history.waited[:1])
    return float(gyro.rate_random_walk) * before**0.5


def _of_calibration(
    calibration: Calibration, sources: Sources, hidden: Mapping[str, float], history: RunHistory | None
) -> dict[str, Any]:
    """The fields that are of a calibration alone."""
    return {
        "axes": tuple(
            AxisFact(
                channel.label,
                tuple(standard_terms(calibration, channel)),
                (str(channel.valid_temperature[0]), str(channel.valid_temperature[1])),
                (str(channel.valid_rate[0]), str(channel.valid_rate[1])),
            )
            for channel in calibration.channel
        ),
        "unobservable": calibration.unobservable,
        "contradicted": calibration.contradicted,
        "fit": tuple((t.name.replace("_", " "), t.statistic, t.degrees, t.chance) for t in calibration.fit),
        "agreement": agreement(calibration, hidden, _walked_before(sources, history)),
        "examples": tuple(examples_of(calibration)),
        "exports": tuple(exports_of(calibration, sources.calibration_name)),
    }


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
