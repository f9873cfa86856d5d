"""Estimates -> calibration files and reports: coefficients in the paper's basis, requirements, verdicts in words."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.linalg import block_diag

from gradcal_jax.api.axis_rows import axis_requirement_row
from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.contract_rows import (
    counted_std,
    finite,
    fit_rows,
    judged_by_data,
    provenance_of,
    random_walks,
    requirement_fields,
    result_of_requirement,
)
from gradcal_jax.api.contradictions import (
    SCALE_FACTOR_ERROR,
    beyond_the_data,
    diagnosis_sentences,
    omitted_sentences,
    refuse_other_units,
)
from gradcal_jax.api.estimate import common_axes, estimate_channels
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.estimated_calibration import residuals_of
from gradcal_jax.api.executed_part import lacks_of
from gradcal_jax.api.log_rows import with_options
from gradcal_jax.api.posterior_of_plan import DEG_PER_S, PPM
from gradcal_jax.api.record_faults import RecordFaults, without_bad_rows
from gradcal_jax.api.standard_estimate import point_channel
from gradcal_jax.api.structure_tests import MeasuredDiscrepancy, discrepancies, structure_in_words
from gradcal_jax.api.systematic import (
    CountedPosteriors,
    EstimatedRun,
    budget_of_estimate,
    omitted_noise,
    ramp_of_record,
    unseen_errors,
)
from gradcal_jax.api.unit_channel import UnitChannel
from gradcal_jax.display import html, summary
from gradcal_jax.estimation import Consistency, Test, contradictions
from gradcal_jax.files import Spec
from gradcal_jax.files.calibration import (
    FORMAT,
    ORDER,
    TEMPERATURE_RATE,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    FitTest,
    Noise,
    UnseenError,
    build_term,
)
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.points import RatePoints
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.requirement_table import narrow_table
from gradcal_jax.information import unobservable_combinations
from gradcal_jax.model import BIAS, SCALE_FACTOR, TEMPERATURE_GRADIENT

# Standard deviations by which two halves of the data differ by chance once in a thousand.
_APART = 3.3


CountedByChannel = Mapping[tuple[str, str], CountedPosteriors]


class EstimateReport(NamedTuple):
    """The result of `estimate_calibration`: a calibration for each unit, and every channel's estimate."""

    calibrations: tuple[Calibration, ...]
    channels: tuple[UnitChannel, ...]
    verdicts: dict[str, tuple[RequirementRow, ...]]
    """The requirements by unit."""
    messages: dict[str, tuple[str, ...]]
    """By unit: sentences to read before the calibration is used."""
    discrepancies: tuple[MeasuredDiscrepancy, ...] = ()
    """By axis and map, of all units together."""

    __repr__ = summary
    _repr_html_ = html

    def _shown(self) -> list[str]:
        lines: list[str] = []
        for one in self.calibrations:
            rows, messages = self.verdicts[one.serial_number], self.messages[one.serial_number]
            lines += [f"Estimate of {one.serial_number}" + (", SIMULATED" if one.simulated else ""), one.valid_range]
            lines += [narrow_table(rows)] if rows else []
            lines += [f"contradicted: {', '.join(one.contradicted)}"] if one.contradicted else []
            lines += [f"not observable: {', '.join(one.unobservable)}"] if one.unobservable else []
            lines += [f"note: {messages[0]}"] if messages else []
            lines += [f"{len(messages) - 1} more notes"] if len(messages) > 1 else []
        return lines

    def unseen_of(self, channel: UnitChannel) -> tuple[UnseenError, ...]:
        """The errors of a channel that no residual of its fit shows."""
        return next((c.unseen for c in self.calibrations if c.serial_number == channel.unit), ())

    @property
    def as_wished(self) -> bool:
        """Whether every requirement is met, every parameter observable and every test passed."""
        rows = [row for rows in self.verdicts.values() for row in rows]
        met = all(row.verdict in (None, "met") for row in rows)
        seen = all(not channel.estimate.known[0].hidden.shape[1] for channel in self.channels)
        return met and seen and not any(contradictions_of(channel) for channel in self.channels)


def estimate_calibration(
    spec: Spec,
    log: Log,
    *,
    axes: Sequence[str] = (),
    units: Sequence[str] = (),
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> EstimateReport:
    """The calibration of every unit in a log, by the spec's model, with covariance, tests and verdicts.

    `sources`: names of the files, for the provenance. **Raises:** `LogError` and `ValueError` with a sentence where the
    log does not hold what the estimate needs.
    """
    lacks = lacks_of(spec, [log])
    spec, options, said = with_options(spec, [log], options or Options())
    estimated = axes or common_axes(assemble(spec), log)
    (log,), faults = without_bad_rows(spec, [log], [f"gyro {axis}" for axis in estimated])
    if log.temperature_c is not None:
        for name in units or log.units:
            refuse_other_units(spec, log.temperature_c[log.unit_index(name)], name)
    try:
        channels = estimate_channels(spec, log, axes=axes, units=units, options=options)
    except ValueError as error:
        # What is missing may be what was left out.
        if not (also := "".join(dict.fromkeys(of_unit.also for of_unit in faults.values()))):
            raise
        raise LogError(f"{error}{also}") from None
    report = _report(spec, log, channels, options, sources, [*([lacks] if lacks else []), *said], faults)
    whole = (c.model_copy(update={"lacks": lacks} if lacks else {}) for c in report.calibrations)
    return report._replace(calibrations=tuple(whole))


def estimate_points(
    spec: Spec, points: RatePoints, *, options: Options | None = None, sources: dict[str, str] | None = None
) -> EstimateReport:
    """The calibration of one axis from a table of points (temperature, reference rate, output, σ), by the spec's model.

    **Raises:** `LogError` for a spec without a standard plan, and for too few points.
    """
    options = options or Options()
    channel = point_channel(assemble(spec), points, options)
    # The calibration describes its log: here one as long as all points together, sampled at their interval.
    time = np.arange(len(points.output_rad_per_s), dtype=np.float64) * float(getattr(spec.schedule, "integration", 1.0))
    log = Log(
        time, points.output_rad_per_s[None, :, None], (points.unit,), (points.axis,), points.temperature_c[None],
        simulated=points.simulated, provenance={"source": points.source},
    )  # fmt: skip
    return _report(spec, log, [channel], options, sources)


def _report(
    spec: Spec,
    log: Log,
    channels: list[UnitChannel],
    options: Options,
    sources: dict[str, str] | None,
    said: Sequence[str] = (),
    faults: Mapping[str, RecordFaults] = MappingProxyType({}),
) -> EstimateReport:
    shown = {channel.unit: faults.get(channel.unit, RecordFaults()) for channel in channels}
    channels = [channel._replace(not_valid=tuple(shown[channel.unit].not_valid)) for channel in channels]
    for channel in channels:
        _refuse_the_absurd(channel, shown[channel.unit].also)
    by_unit: dict[str, list[UnitChannel]] = {}
    for channel in channels:
        by_unit.setdefault(channel.unit, []).append(channel)
    built = assemble(spec)
    noise: dict[Axis, dict[str, np.ndarray]] = {axis: omitted_noise(built, axis) for axis in built.channels}
    budgets = {(c.unit, c.axis): _budget(built, c, noise) for c in channels}
    verdicts = {unit: tuple(v for c in own for v in _verdicts(budgets, c)) for unit, own in by_unit.items()}
    messages = {
        unit: (
            *said,
            *shown[unit].sentences,
            *(m for c in own for m in words(c, len(own) > 1)),
            *_beside_verdicts(spec, own),
        )
        for unit, own in by_unit.items()
    }
    calibrations = tuple(
        _calibration(spec, log, unit, own, budgets, verdicts[unit], options, sources or {})
        for unit, own in by_unit.items()
    )
    tests = [(f"gyro_{c.axis}", test) for c in channels for test in c.structure]
    measured = tuple(discrepancies(spec, tests))
    return EstimateReport(calibrations, tuple(channels), verdicts, messages, measured)


def _refuse_the_absurd(channel: UnitChannel, also: str) -> None:
    """Raise `LogError` for a scale-factor error that no gyro has: the reference must be wrong."""
    scale = channel.model.scale
    if scale is None or scale.rate is None:
        return
    where = channel.model.where(SCALE_FACTOR)
    temperature = np.linspace(*channel.valid_temperature_c, 5)
    rate = np.linspace(*channel.valid_rate_rad_per_s, 7)
    if not rate.any() or not np.all(
        np.isfinite(channel.estimate.known[0].deviations(channel.model.to_reported[where]))
    ):
        return
    table = channel.estimate.parameters[0][where].reshape(scale.temperature.size, scale.rate.size)
    values = scale.temperature(temperature) @ table @ np.asarray(scale.rate(rate)).T
    if (largest := float(np.max(np.abs(values)))) > SCALE_FACTOR_ERROR:
        raise LogError(
            f"axis {channel.axis} of {channel.unit}: a scale-factor error of {largest * PPM:.4g} ppm is not a gyro's: "
            f"is the reference of another axis, unit or sign, or are the listed turns wrong?{also}"
        )


def contradictions_of(channel: UnitChannel) -> list[str]:
    """What makes a channel's calibration not valid, by name: what its record shows, and tests of the fit that fail."""
    structure = {f"structure of the {test.quantity.replace('_', ' ')}": test.test for test in channel.structure}
    return [*channel.not_valid, *contradictions(_tests_of(channel.consistency) | structure)]


def _tests_of(tests: Consistency) -> dict[str, Test]:
    named = {"χ² of the fit": tests.fit, "whiteness of the residuals": tests.whiteness}
    return named | {split.name: split.agreement for split in tests.splits}


def not_valid(contradicted: Sequence[str], where: str = "") -> list[str]:
    """A sentence on tests that fail, where any does."""
    if not contradicted:
        return []
    return [
        f"{where}not valid: {'; '.join(contradicted)}: the data contradict the model, and no stated uncertainty holds"
    ]


def _budget(built: Assembled, channel: UnitChannel, noise: Mapping[Axis, dict[str, np.ndarray]]) -> CountedPosteriors:
    """The posteriors of one channel. Residuals that are larger than the spec's noise explains make the covariance of
    the fit too small by as much."""
    known, seen = channel.estimate.known[0], channel.observations
    known = known._replace(spread=known.spread * excess_of(channel.consistency))
    done = EstimatedRun(
        channel.estimate.parameters[0],
        channel.valid_temperature_c,
        # At stable temperatures nothing lags, and between them no data are used.
        0.0 if isinstance(built.spec.plan, StandardPlan) else ramp_of_record(seen.time_s, seen.temperature_c),
        channel.lag_std_s,
    )
    of_axis = noise.get(cast("Axis", channel.axis), noise[built.channels[0]])
    return budget_of_estimate(built._replace(model=channel.model), known, done, of_axis)


def _verdicts(budgets: CountedByChannel, channel: UnitChannel) -> list[RequirementRow]:
    budget, contradicted = budgets[channel.unit, channel.axis], contradictions_of(channel)
    rows: list[RequirementRow] = []
    for requirement in budget.built.spec.requirement:
        row = axis_requirement_row(budget.built, budget, requirement, budget.built.channels[0])
        beyond = beyond_the_data(requirement, *_covered(channel))
        rows.append(judged_by_data(row, beyond, contradicted).model_copy(update={"axis": channel.axis}))
    return rows


def _covered(channel: UnitChannel) -> tuple[tuple[float, float], tuple[float, float]]:
    return channel.valid_temperature_c, channel.valid_rate_rad_per_s


def _beside_verdicts(spec: Spec, channels: Sequence[UnitChannel]) -> list[str]:
    """What a reader of the verdicts must know: terms that the spec omits, and requirements beyond the data."""
    sentences = omitted_sentences(spec, channels[0].observations.temperature_c, channels[0].lag_std_s is not None)
    beyond = (beyond_the_data(r, *_covered(c)) for c in channels for r in spec.requirement)
    return [*sentences, *dict.fromkeys(sentence for sentence in beyond if sentence)]


def excess_of(tests: Consistency) -> float:
    """The factor by which residuals exceed the spec's noise where the χ² test fails; otherwise 1."""
    return max(1.0, tests.noise_scale) if not tests.fit.passed and tests.fit.degrees > 0 else 1.0


def words(channel: UnitChannel, several: bool = False) -> list[str]:
    """Where the data contradict the model or do not observe it, in sentences."""
    tests = channel.consistency
    where = f"axis {channel.axis}: " if several else ""
    sentences, names = not_valid(contradictions_of(channel), where), channel.model.names()
    sentences += [where + message for message in channel.messages]
    unseen = unobservable_combinations(channel.estimate.known[0], channel.model)
    sentences += [f"{where}the data say nothing of {combination}" for combination in unseen]
    if tests.fit.degrees > 0:
        sentences += [where + sentence for sentence in noise_sentences(tests, not tests.fit.passed, "sensor")]
    if contradictions_of(channel):
        seen = channel.observations
        moved = seen.rate_rad_per_s[seen.used] != 0.0
        own = diagnosis_sentences(channel.estimate.residuals[0], seen.time_s[seen.used], moved)
        sentences += [where + sentence for sentence in own]
    if not tests.whiteness.passed:
        sentences.append(f"{where}the residuals are not white: the spec's noise does not explain their correlation")
    sentences += [where + structure_in_words(test) for test in channel.structure if test.noticed]
    for split in tests.splits:
        if split.agreement.passed:
            continue
        worst = [names[k] for k in np.flatnonzero(np.abs(np.nan_to_num(split.differences)) > _APART)]
        culprits = f"; these do not generalise: {', '.join(worst)}" if worst else ""
        sentences.append(
            f"{where}{split.name}: the parts disagree (chance {split.agreement.probability:.1g}){culprits}"
        )
    return sentences


def noise_sentences(tests: Consistency, larger: bool, what: str) -> list[str]:
    """A sentence where the residuals are `larger`, or far smaller, than the spec's noise says."""
    if larger:
        return [
            f"the residuals are {tests.noise_scale:.3g} times as large as the spec's noise says: the model lacks "
            "something, or the noise figures are too small; requirements are judged with the larger noise"
        ]
    if tests.fit.probability <= 1.0 - 1e-3:
        return []
    return [
        f"the residuals are only {tests.noise_scale:.3g} times what the spec's noise says: its figures are larger than "
        f"this {what}'s"
    ]


def _calibration(
    spec: Spec,
    log: Log,
    unit: str,
    channels: list[UnitChannel],
    budgets: CountedByChannel,
    verdicts: tuple[RequirementRow, ...],
    options: Options,
    sources: dict[str, str],
) -> Calibration:
    parts = [_channel(spec, channel, budgets[unit, channel.axis]) for channel in channels]
    rows: dict[str, Any] = {
        key: tuple(row for part in parts for row in getattr(part, key))
        for key in ("unseen", "fit", "contradicted", "unobservable")
    }
    rows["result"] = tuple(map(result_of_requirement, verdicts))
    return Calibration(
        format=FORMAT,
        title=spec.title or spec.sensor.name or f"calibration of {unit}",
        serial_number=unit,
        simulated=log.simulated,
        frame="the sensor's own axes " + ", ".join(channel.axis for channel in channels) + ", not orthogonalised",
        order=ORDER,
        channel=tuple(part.channel for part in parts),
        covariance=joined([part.covariance for part in parts]),
        **{key: value for key, value in rows.items() if value},
        noise=Noise(sample_rate=Quantity.of(1.0 / log.sample_interval_s, "Hz"), **random_walks(spec.sensor)),
        provenance=provenance_of(
            [log],
            unit,
            sources,
            estimator=_estimator(options, channels[0]),
            readings=", ".join(f"{c.axis}: {len(c.weights)}" for c in channels),
        ),
    )


def joined(blocks: Sequence[Covariance]) -> Covariance:
    """One covariance of channels that were estimated each by itself."""
    matrix = np.asarray(block_diag(*(np.array(block.matrix).reshape(2 * (len(block.names),)) for block in blocks)))
    return Covariance(
        names=tuple(name for block in blocks for name in block.names), matrix=tuple(map(tuple, matrix.tolist()))
    )


def _estimator(options: Options, channel: UnitChannel) -> str:
    parts = ["generalised least squares of whitened readings"]
    if options.robust:
        parts.append(f"robust (Huber {options.threshold:g})")
    if channel.lag_std_s is not None:
        parts.append(f"lag fitted: {channel.lag_s:.4g} s, 1 sigma {channel.lag_std_s:.2g} s")
    if channel.smoothness is not None:
        parts.append("smoothness by marginal likelihood")
    if options.clock == "host":
        parts.append("time of the computer")
    return "; ".join(parts)


class ChannelPart(NamedTuple):
    """What one channel's estimate adds to a calibration file, with the names of the file."""

    channel: CalibratedChannel
    covariance: Covariance
    unseen: tuple[UnseenError, ...]
    fit: tuple[FitTest, ...]
    contradicted: tuple[str, ...]
    unobservable: tuple[str, ...]


def _channel(spec: Spec, channel: UnitChannel, budget: CountedPosteriors) -> ChannelPart:
    model, known = channel.model, channel.estimate.known[0]
    reported, name = model.to_reported[: model.calibrated], f"gyro_{channel.axis}"
    values = reported @ channel.estimate.parameters[0]
    names = [f"{name}.{symbol}" for symbol in model.names()[: model.calibrated]]
    seen = np.flatnonzero(np.isfinite(known.deviations(reported)))
    covariance = known.covariance(reported)[np.ix_(seen, seen)] * excess_of(channel.consistency) ** 2

    def term(symbol: str, quantity: str, unit: str, signals: tuple[str, ...], **bases: Any) -> CalibratedTerm:
        where = model.where(quantity)
        coefficients = dict(zip(model.names()[where], values[where].tolist(), strict=True))
        return build_term(symbol, unit, signals, coefficients, **bases)

    terms: list[CalibratedTerm] = []
    if (of := spec.sensor.bias) is not None:
        terms.append(term("bias", BIAS, "rad/s", (), temperature=of.temperature))
    if (of := spec.sensor.scale_factor) is not None:
        bases = {"temperature": of.temperature, "rate": of.rate}
        terms.append(term("scale_factor", SCALE_FACTOR, "1", (f"rate {channel.axis}",), **bases))
    if model.term(TEMPERATURE_GRADIENT) is not None:
        terms.append(term("bias_temperature_gradient", TEMPERATURE_GRADIENT, "rad/K", (TEMPERATURE_RATE,)))
    (low, high), (slow, fast) = channel.valid_temperature_c, channel.valid_rate_rad_per_s
    lag = {"thermal_lag": Quantity.of(channel.lag_s, "s")} if channel.lag_s > 0.0 else {}
    tests = [(f"{name}: {test}", t) for test, t in _tests_of(channel.consistency).items()]
    return ChannelPart(
        CalibratedChannel(
            kind="gyro",
            axis=channel.axis,
            valid_temperature=(_shown(low, 1.0, "degC"), _shown(high, 1.0, "degC")),
            valid_rate=(_shown(slow, DEG_PER_S, "deg/s"), _shown(fast, DEG_PER_S, "deg/s")),
            term=tuple(terms),
            residuals=residuals_of(channel.estimate.residuals[0]),
            **lag,
        ),
        Covariance(names=tuple(names[k] for k in seen), matrix=tuple(map(tuple, covariance.tolist()))),
        unseen_errors(budget, names, reported),
        fit_rows((n, t) for n, t in tests if np.isfinite(t.statistic) and np.isfinite(t.probability)),
        tuple(f"{name}: {test}" for test in contradictions_of(channel)),
        tuple(f"{name}: {combination}" for combination in unobservable_combinations(known, model)),
    )


def _shown(value: float, factor: float, unit: str) -> Quantity:
    """A quantity with one decimal, in `unit`."""
    dimension = "temperature" if unit == "degC" else "angular rate"
    return Quantity.read(f"{value * factor:.1f} {unit}".replace("-0.0 ", "0.0 "), dimension)


# --- for people and programs ------------------------------------------------------------------------------------------


def estimate_rows(report: EstimateReport) -> dict[str, Any]:
    """Plain numbers for `--json`."""
    return {
        "simulated": any(c.simulated for c in report.calibrations),
        "as_wished": report.as_wished,
        "discrepancies": [row._asdict() for row in report.discrepancies],
        "units": [
            {
                "serial_number": c.serial_number,
                "channels": [
                    _channel_row(one, report.unseen_of(one)) for one in report.channels if one.unit == c.serial_number
                ],
                "requirements": [requirement_fields(row) for row in report.verdicts[c.serial_number]],
                "messages": list(report.messages[c.serial_number]),
            }
            for c in report.calibrations
        ],
    }


def _channel_row(channel: UnitChannel, unseen: Sequence[UnseenError]) -> dict[str, Any]:
    model = channel.model
    reported = model.to_reported
    names = model.names()
    known = channel.estimate.known[0]
    values, deviations = reported @ channel.estimate.parameters[0], known.deviations(reported)
    covariance, seen = known.covariance(reported), np.isfinite(deviations)
    tests = channel.consistency
    return {
        "axis": channel.axis,
        "readings": len(channel.weights),
        "rows": channel.counts,
        "parameters": [
            {
                "name": n,
                "value": float(v),
                "std": finite(s),
                "std_counted": counted_std(f"gyro_{channel.axis}.{n}", finite(s), unseen),
                "unit": u,
            }
            for n, v, s, u in zip(names, values, deviations, model.units(), strict=True)
        ],
        "covariance": np.where(np.outer(seen, seen), covariance, cast("Any", None)).tolist(),
        "valid_temperature_c": list(channel.valid_temperature_c),
        "valid_rate_dps": [r * DEG_PER_S for r in channel.valid_rate_rad_per_s],
        "lag_s": channel.lag_s,
        "lag_std_s": finite(channel.lag_std_s),
        "smoothness": None if channel.smoothness is None else channel.smoothness._asdict(),
        "neighbours": [
            {
                "temperature_c": g.temperature_c,
                "rate_dps": g.rate_rad_per_s * DEG_PER_S,
                "moves": g.moves,
                "scale_factor_ppm": g.scale_factor * PPM,
                "standard_error_ppm": None if g.standard_error is None else g.standard_error * PPM,
                "map_ppm": g.of_map * PPM,
            }
            for g in channel.neighbours
        ],
        "structure": [
            {
                "quantity": t.quantity,
                "test": t.test._asdict(),
                "false_alarm": t.false_alarm,
                "noticed": t.noticed,
                "degrees_asked": None if t.asked is None else list(t.asked),
            }
            for t in channel.structure
        ],
        "down_weighted": int(np.count_nonzero(channel.weights < 1.0)),
        "consistency": {
            "chi_squared": tests.fit._asdict(),
            "noise_scale": finite(tests.noise_scale),
            "whiteness": tests.whiteness._asdict(),
            "share_beyond_three_sigma": tests.beyond_three,
            "largest_residual_sigma": tests.largest,
            "splits": [
                {
                    "name": s.name,
                    "readings": list(s.counts),
                    "agreement": s.agreement._asdict(),
                    "held_out": s.held_out._asdict(),
                    "differences_sigma": {n: finite(d) for n, d in zip(names, s.differences, strict=True)},
                }
                for s in tests.splits
            ],
        },
    }
