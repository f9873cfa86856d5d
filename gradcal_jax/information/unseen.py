"""Errors that no residual of a run shows, as columns of a posterior's spread.

Within one run the sample clock, the scale of an encoder, the cosine of a mounting, the offset of a thermometer or the
Earth's rate act as a constant of a map, or as its slope over temperature: the data fit as well with them as without,
and the estimate is off by a direction `v` of the parameters times the error. Each is therefore no parameter, but a
column of the posterior's spread: the covariance is `C + Σ v vᵀ`, for predictions and estimates.

A lag of the temperature and a sensitivity to dT/dt that are no parameters do show in the data, in part: on a way there
and back they cancel. Of them counts what they leave in the estimate of this very plan or log, by the answers of its
least squares (`imu_rows.imu_information`).

`θ` of the input axis against the table's, each of two angles with standard deviation σ, multiplies the scale factor by
`cos θ ≈ 1 − (θ₁² + θ₂²)/2`, whose root mean square is √2 σ². The Earth's rate along an axis of unknown direction is
rectangular within ±15.04 deg/h (GUM, 4.3.7).
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.arrays import namespace
from gradcal_jax.calibration.file import UnseenError
from gradcal_jax.information import Posterior, posterior
from gradcal_jax.information.gears import BACKLASH, SCALE_OF_ANGLE
from gradcal_jax.information.plan_information import imu_posterior, plan_information
from gradcal_jax.model import (
    AXIS_NAMES,
    BIAS,
    SCALE_FACTOR,
    TEMPERATURE_GRADIENT,
    Channel,
    GradientOfBias,
    Hysteresis,
    ImuModel,
    Map,
    ProductTerm,
    Term,
)
from gradcal_jax.model.build import BuiltImu, build_imu, unweighted_estimator
from gradcal_jax.model.nodes import INPUTS
from gradcal_jax.motion import EARTH_RATE, Turns, turns_of
from gradcal_jax.spec.absent import absent_terms, with_typical
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.typical import slopes_of

TURN_ON: Final = "turn-on bias"
BESIDE_THE_AXIS: Final = "misalignment of the input axis from the table's axis"
UNKNOWN_EARTH_RATE: Final = EARTH_RATE / 3.0**0.5
# Temperatures at which the slope of a map is taken, and the step of the difference, K.
_AT: Final = 64
_STEP_K: Final = 0.01
# Share of a coefficient's variance below which a column is left out of a file.
_NEGLIGIBLE: Final = 1e-4
# Last parts of the keys of omitted terms that are no noise: columns, or terms with parameters.
_NO_NOISE: Final = frozenset({
    "thermal_lag", "bias_temperature_gradient", "temperature_offset", "temperature_lag", "mounting_accuracy",
    "scale_error", "backlash", "turn_on_bias", "hysteresis", "scale_factor_hysteresis", "lever_arm",
})  # fmt: skip

Columns = Mapping[str, np.ndarray]


class Answers(NamedTuple):
    """By how much an estimate is off for one unit of an error that it does not know, `(p,)` for each channel: a bias by
    dT/dt (rad/s or m/s² for K/s), and a temperature that is late by a second."""

    gradient: Sequence[np.ndarray]
    lag: Sequence[np.ndarray]


class EstimatedRun(NamedTuple):
    """An estimate in the place of a plan: its parameters `(p,)`, the range of temperature of its data (°C), its
    answers, and the standard deviation of its lag (s) beyond what the covariance contains (None: the spec's).
    `one_way`: the temperature never returns; `clock_doubt`: a ratio by which the log's clocks are apart."""

    parameters: np.ndarray
    temperature_c: tuple[float, float]
    answers: Answers
    lag_std: float | None = None
    one_way: bool = False
    clock_doubt: float = 0.0


class CountedPosteriors(NamedTuple):
    """Posteriors of a plan or an estimate. `own`: with what the spec names; `whole`: with what it omits, at its class's
    typical figures; `any_run`: with the bias of another power-on as well. `built`: whose model the last two are of.
    `fit`, `columns`: the parts of `any_run`: of noise and priors alone, and of what no residual shows, by name (in an
    estimate without the turn-on bias)."""

    own: Posterior
    whole: Posterior
    any_run: Posterior
    built: Any
    fit: Posterior
    columns: Columns = MappingProxyType({})

    def judged(self, run: str) -> Posterior:
        """What a verdict judges in "any run" or in "this run"."""
        return self.any_run if run == "any run" else self.whole


def drifting_terms(built: BuiltImu) -> list[tuple[int, Term]]:
    """Errors by dT/dt that a plan's estimate does not know, of every channel a bias and a scale factor; none where the
    temperature stays, and where the spec names none."""
    sensor, line, channels = built.spec.sensor, built.motion.line, built.model.channels
    still = not np.any(line.slope) and not np.any(line.excess)
    biases = [getattr(sensor, c.kind).gradient_std for c in channels if c.term(TEMPERATURE_GRADIENT) is None]
    terms = list[tuple[int, Term]]()
    if still or unweighted_estimator(built.spec) or not (sensor.temperature_lag or any(biases)):
        return terms
    for number, c in enumerate(channels):
        own = f"{INPUTS[c.kind]} {AXIS_NAMES[c.axis]}"
        of_scale = ProductTerm(std=np.ones(()), name=SCALE_FACTOR, unit="s/K", signals=(own,), slopes=1)
        terms += [(number, GradientOfBias(std=np.inf)), (number, of_scale)]
    return terms


def answers_of(built: BuiltImu, columns: Any = None) -> Answers:
    """The answers of a plan's estimate, of which `columns` `(p, k)` are those to its drifting terms (None: it has
    none)."""
    channels, nothing = built.model.channels, np.zeros(built.model.size)
    if columns is None:
        return Answers([nothing] * len(channels), [nothing] * len(channels))
    gradient, by_scale = columns.T[::2], columns.T[1::2]
    slopes = [slopes_of(built.spec.sensor, c.kind) for c in channels]
    lag = [-of[0] * a - of[1] * b for of, a, b in zip(slopes, gradient, by_scale, strict=True)]
    return Answers(list(gradient), lag)


def posterior_and_answers(built: BuiltImu, known: Posterior | None = None) -> tuple[Posterior, Answers]:
    """The posterior of a unit's plan, and the answers of its estimate to what it does not know. `known`: the posterior,
    if it was computed."""
    terms = drifting_terms(built)
    if not terms:
        return known or imu_posterior(built), answers_of(built)
    info, columns = plan_information(built, terms)
    return posterior(info), answers_of(built, columns)


def unseen_columns(
    built: BuiltImu, answers: Answers, spec: Spec | None = None, done: EstimatedRun | None = None
) -> dict[str, Any]:
    """Columns `(p, k)` by the name of their error, as far as `spec` names it (None: the unit's own). A sensitivity to
    dT/dt, a hysteresis or gears that the model estimates are in its covariance. In a plan a map has its class's slopes,
    in an estimate (`done`) its own."""
    model, spec = built.model, spec or built.spec
    sensor = spec.sensor
    lag = float(sensor.temperature_lag or 0.0) if done is None or done.lag_std is None else done.lag_std
    scales, backlash = _of_table(built, spec)
    scales["clocks that contradict each other"] = 0.0 if done is None else done.clock_doubt
    turns = turns_of(built.motion) if backlash else None
    # A calibration does not carry the functions that a discrepancy adds.
    carried = model.discrepancy_stds == 0.0
    columns: dict[str, list[Any]] = {}

    def add(name: str, std: float, column: Any) -> None:
        if std and (namespace(column) is not np or np.any(column)):
            columns.setdefault(name, []).append(std * column)

    for number, c in enumerate(model.channels):
        triad = getattr(sensor, c.kind)
        constants = {name: _constant(model, c, name) for name in (BIAS, SCALE_FACTOR)}
        if c.kind == "gyro":
            for name, std in scales.items():
                add(name, std, constants[SCALE_FACTOR])
            if spec.rig.site.is_unknown:
                add("Earth's rate", UNKNOWN_EARTH_RATE, constants[BIAS])
            if turns is not None:
                add(BACKLASH, backlash, _by_backlash(model, c, turns))
        if done is not None:
            for name, plays in ((BIAS, triad.hysteresis), (SCALE_FACTOR, triad.scale_factor_hysteresis)):
                size = float(np.hypot.reduce([float(p.prior) * float(p.width) for p in plays], initial=0.0))
                # A map from one branch is off by twice as much on the other as one from both.
                if not _estimates_plays(c, name):
                    add("hysteresis", size * (2.0 if done.one_way else 1.0), constants[name])
        if c.term(TEMPERATURE_GRADIENT) is None:
            add("bias from dT/dt", triad.gradient_std, carried * answers.gradient[number])
        if done is None:
            by_bias, by_scale = slopes_of(sensor, c.kind)
            slope = by_bias * constants[BIAS] + by_scale * constants[SCALE_FACTOR]
        else:
            slope = _slopes(model, c, done)
        add("offset of the temperature", float(sensor.temperature_offset or 0.0), slope)
        add("lag of the temperature", lag, carried * answers.lag[number])
    return {name: namespace(*of).stack(of, axis=1) for name, of in columns.items()}


def _of_table(built: BuiltImu, spec: Spec) -> tuple[dict[str, float], float]:
    """Relative errors of the gyros' scale factor by the table, by name, and its backlash, rad; zero where the unit's
    model estimates the gears."""
    table, gyro = spec.rig.table, spec.sensor.gyro
    scales, lashes = np.reshape(built.gears, (-1, 2)).T
    # A table of several axes sees the directions of the input axes.
    seen = len(table.axis) > 1 or (gyro is not None and gyro.misalignment is not None)
    mounting = 0.0 if seen else float(table.mounting[0].accuracy)
    scale = 0.0 if np.any(scales) else max(float(axis.angle.scale_error or 0.0) for axis in table.axis)
    backlash = 0.0 if np.any(lashes) else max(float(axis.angle.backlash or 0.0) for axis in table.axis)
    return {BESIDE_THE_AXIS: 2.0**0.5 * mounting**2, SCALE_OF_ANGLE: scale}, backlash


def _estimates_plays(channel: Channel, name: str) -> bool:
    """Whether plays of a channel's map are parameters."""
    plays = (term for term in channel.terms if isinstance(term, Hysteresis))
    return any(bool(term.signals) == (name == SCALE_FACTOR) for term in plays)


def _constant(model: ImuModel, channel: Channel, name: str) -> np.ndarray:
    """Parameters `(p,)` of a channel's term that is 1 everywhere; zero without the term."""
    column, term = np.zeros(model.size), channel.term(name)
    if isinstance(term, Map):
        column[model.where(channel.kind, channel.axis, name)] = term.constant
    return column


def _by_backlash(model: ImuModel, channel: Channel, turns: Turns) -> np.ndarray:
    """Parameters `(p,)` of the scale factor by which turns seem larger than they are, each weighted with its size."""
    column, term = np.zeros(model.size), channel.term(SCALE_FACTOR)
    if isinstance(term, Map):
        functions = np.asarray(term.values(turns.temperature_c, turns.rate)) * turns.size[:, None]
        own = np.linalg.lstsq(functions, turns.lost * turns.size, rcond=1e-6)[0]
        column[model.where(channel.kind, channel.axis, SCALE_FACTOR)] = own
    return column


def _slopes(model: ImuModel, channel: Channel, done: EstimatedRun) -> np.ndarray:
    """Parameters `(p,)` of the estimated terms' derivatives in temperature, `(1/K)`, by least squares over the data's
    temperatures: exact for polynomials."""
    column = np.zeros(model.size)
    low, high = done.temperature_c
    at = np.linspace(low, max(high, low + 1.0), _AT)
    for term in channel.terms:
        if not isinstance(term, Map):
            continue
        where = model.where(channel.kind, channel.axis, term.name)
        functions = term.temperature(at)
        change = (term.temperature(at + _STEP_K) - term.temperature(at - _STEP_K)) / (2.0 * _STEP_K)
        # A map over rate is a tensor product, temperature first.
        own = done.parameters[where].reshape(functions.shape[1], -1)
        column[where] = np.linalg.lstsq(functions, change @ own, rcond=None)[0].ravel()
    return column


def widened(known: Posterior, columns: Columns) -> Posterior:
    """The posterior with further errors, each a set of columns `(p, k)`."""
    return known._replace(spread=np.concatenate([known.spread, *columns.values()], axis=1)) if columns else known


def _another_run(spec: Spec, model: ImuModel) -> dict[str, np.ndarray]:
    """Columns for the bias of another power-on."""
    sizes = [float(getattr(spec.sensor, c.kind).turn_on_bias or 0.0) for c in model.channels]
    columns = [size * _constant(model, c, BIAS) for size, c in zip(sizes, model.channels, strict=True)]
    return {TURN_ON: np.stack(columns, axis=1)} if np.any(columns) else {}


def own_of_imu(built: BuiltImu, known: Posterior | None = None) -> Posterior:
    """The posterior of a unit's plan with what the spec names."""
    known, answers = posterior_and_answers(built, known)
    return widened(known, unseen_columns(built, answers))


def budget_of_imu(built: BuiltImu, known: Posterior, complete: BuiltImu) -> CountedPosteriors:
    """The posteriors of a unit's plan; `complete`: with what the spec omits."""
    fit, answers = posterior_and_answers(complete, known if complete is built else None)
    turn_on, every = _another_run(complete.spec, complete.model), unseen_columns(complete, answers)
    whole = widened(fit, every)
    own = whole if complete is built else own_of_imu(built, known)
    return CountedPosteriors(own, whole, widened(whole, turn_on), complete, fit, every | turn_on)


def budget_of_estimate(built: BuiltImu, known: Posterior, done: EstimatedRun, noise: Columns) -> CountedPosteriors:
    """The posteriors of an estimate. `noise`: of `omitted_noise_of_imu`."""
    complete = with_typical(built.spec)
    own, whole = (unseen_columns(built, done.answers, spec, done) for spec in (built.spec, complete))
    left, columns = widened(known, own), {**whole, **noise}
    counted = widened(known, columns) if absent_terms(built.spec) else left
    turn_on = _another_run(complete, built.model)
    return CountedPosteriors(left, counted, widened(counted, turn_on), built, known, columns)


def floor_of_plan(spec: Spec) -> tuple[BuiltImu, Posterior]:
    """What no residual of any plan shows, as far as the spec names it, as a posterior of its own, and its model."""
    built = build_imu(spec)
    nothing = np.zeros((built.model.size, 0))
    # Longer turns lose less to backlash, and another course less to what the temperature's rate adds.
    columns = unseen_columns(built, answers_of(built))
    return built, widened(Posterior(nothing, nothing), {n: c for n, c in columns.items() if n != BACKLASH})


def unseen_errors(budget: CountedPosteriors, names: Sequence[str], reported: np.ndarray) -> tuple[UnseenError, ...]:
    """The errors of an estimate that no residual shows, in the coefficients `names`; `reported` `(n, p)`: the engine's
    parameters to these."""
    variance = np.sum((reported @ budget.whole.spread) ** 2, axis=1)
    rows: list[UnseenError] = []
    for name, columns in budget.columns.items():
        for column in (reported @ columns).T:
            large = column**2 > _NEGLIGIBLE * variance
            if np.any(large):
                own = {n: float(v) for n, v in zip(names, column, strict=True) if v != 0.0}
                rows.append(UnseenError(name=name, coefficients=own))
    return tuple(rows)


def omitted_noise_of_imu(built: BuiltImu) -> dict[str, np.ndarray]:
    """Columns of what the noise that a spec omits adds to the covariance of the sensor's own parameters after the
    spec's own plan: of omitted terms that are noise, or parameters of the table, at typical figures."""
    noise = {t.key: t.value for t in absent_terms(built.spec) if t.key.rpartition(".")[2] not in _NO_NOISE}
    if not noise:
        return {}
    own, columns = built.model.calibrated, np.zeros((built.model.size, built.model.calibrated))
    both = (imu_posterior(built), imu_posterior(build_imu(changed(built.spec, noise))))
    plan, noisy = (known.spread[:own] @ known.spread[:own].T for known in both)
    scale = np.sqrt(np.maximum(np.diag(noisy), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((noisy - plan) / np.outer(scale, scale))
    columns[:own] = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return {"omitted noise": columns}
