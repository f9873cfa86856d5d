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

from collections.abc import Callable, Iterator, Mapping, Sequence
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
    """Posteriors of a plan or an estimate. `own`: with what the spec names. For verdicts, with what it omits at its
    class's typical figures: the model (`built`), the posterior of noise and priors alone (`fit`), and the `columns` of
    what no residual shows, by name. `complete`: the spec omits nothing."""

    own: Posterior
    built: BuiltImu
    fit: Posterior
    columns: Columns
    complete: bool

    def counted(self, run: str) -> Columns:
        """The columns that count in "any run", with another power-on, or in "this run"."""
        return {name: of for name, of in self.columns.items() if run == "any run" or name != TURN_ON}

    def judged(self, run: str) -> Posterior:
        """What a verdict judges in "any run" or in "this run"."""
        return widened(self.fit, self.counted(run))


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
    channels = built.model.channels
    if columns is None:
        columns = np.zeros((built.model.size, 2 * len(channels)))
    gradient, by_scale = columns.T[::2], columns.T[1::2]
    lag = []
    for k, c in enumerate(channels):
        of_bias, of_scale = slopes_of(built.spec.sensor, c.kind)
        lag.append(-of_bias * gradient[k] - of_scale * by_scale[k])
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
    columns: dict[str, list[Any]] = {}
    for name, std, column in _unseen(built, answers, spec or built.spec, done):
        if std and (namespace(column) is not np or np.any(column)):
            columns.setdefault(name, []).append(std * column)
    return {name: namespace(*of).stack(of, axis=1) for name, of in columns.items()}


def _unseen(
    built: BuiltImu, answers: Answers, spec: Spec, done: EstimatedRun | None
) -> Iterator[tuple[str, float, Any]]:
    """The errors of every channel: name, standard deviation, and what a unit of it changes in the parameters."""
    model, sensor, site = built.model, spec.sensor, spec.rig.site
    lag = float(sensor.temperature_lag or 0.0) if done is None or done.lag_std is None else done.lag_std
    scales, backlash = _of_table(built, spec)
    turns = turns_of(built.motion) if backlash else None
    # A calibration does not carry the functions that a discrepancy adds.
    carried = model.discrepancy_stds == 0.0
    for number, c in enumerate(model.channels):
        triad = getattr(sensor, c.kind)
        of_bias, of_scale = (_column(model, c, name, lambda term: term.constant) for name in (BIAS, SCALE_FACTOR))
        if c.kind == "gyro":
            for name, std in scales.items():
                yield name, std, of_scale
            yield "clocks that contradict each other", 0.0 if done is None else done.clock_doubt, of_scale
            yield "Earth's rate", UNKNOWN_EARTH_RATE * site.is_unknown, of_bias
            if turns is not None:
                yield BACKLASH, backlash, _column(model, c, SCALE_FACTOR, lambda term, of=turns: _lost(term, of))
        if done is not None:
            # A map from one branch is off by twice as much on the other as one from both.
            branches = 2.0 if done.one_way else 1.0
            plays = ((of_bias, triad.hysteresis, False), (of_scale, triad.scale_factor_hysteresis, True))
            for constant, stated, scaled in plays:
                if not any(isinstance(term, Hysteresis) and bool(term.signals) == scaled for term in c.terms):
                    size = np.hypot.reduce([float(p.prior) * float(p.width) for p in stated], initial=0.0)
                    yield "hysteresis", branches * float(size), constant
        if c.term(TEMPERATURE_GRADIENT) is None:
            yield "bias from dT/dt", triad.gradient_std, carried * answers.gradient[number]
        if done is None:
            by_bias, by_scale = slopes_of(sensor, c.kind)
            slope = by_bias * of_bias + by_scale * of_scale
        else:
            slope = _slopes(model, c, done)
        yield "offset of the temperature", float(sensor.temperature_offset or 0.0), slope
        yield "lag of the temperature", lag, carried * answers.lag[number]


def _of_table(built: BuiltImu, spec: Spec) -> tuple[dict[str, float], float]:
    """Relative errors of the gyros' scale factor by the table, by name, and its backlash, rad; zero where the unit's
    model estimates the gears."""
    table, gyro = spec.rig.table, spec.sensor.gyro

    def largest(name: str, of_gears: int) -> float:
        if any(gear[of_gears] for gear in built.gears):
            return 0.0
        return max(float(getattr(axis.angle, name) or 0.0) for axis in table.axis)

    # A table of several axes sees the directions of the input axes.
    seen = len(table.axis) > 1 or (gyro is not None and gyro.misalignment is not None)
    mounting = 0.0 if seen else float(table.mounting[0].accuracy)
    scales = {BESIDE_THE_AXIS: 2.0**0.5 * mounting**2, SCALE_OF_ANGLE: largest("scale_error", 0)}
    return scales, largest("backlash", 1)


def _column(model: ImuModel, channel: Channel, name: str, own: Callable[[Map], np.ndarray]) -> np.ndarray:
    """Parameters `(p,)`, of a channel's map alone; zero without the map."""
    column, term = np.zeros(model.size), channel.map(name)
    if term is not None:
        column[model.where(channel.kind, channel.axis, name)] = own(term)
    return column


def _lost(term: Map, turns: Turns) -> np.ndarray:
    """Parameters of the scale factor by which turns seem larger than they are, each weighted with its size."""
    functions = np.asarray(term.values(turns.temperature_c, turns.rate)) * turns.size[:, None]
    return np.linalg.lstsq(functions, turns.lost * turns.size, rcond=1e-6)[0]


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
    columns = [
        float(getattr(spec.sensor, c.kind).turn_on_bias or 0.0) * _column(model, c, BIAS, lambda term: term.constant)
        for c in model.channels
    ]
    return {TURN_ON: np.stack(columns, axis=1)} if np.any(columns) else {}


def own_of_imu(built: BuiltImu, known: Posterior | None = None) -> Posterior:
    """The posterior of a unit's plan with what the spec names."""
    known, answers = posterior_and_answers(built, known)
    return widened(known, unseen_columns(built, answers))


def budget_of_imu(built: BuiltImu, known: Posterior, complete: BuiltImu) -> CountedPosteriors:
    """The posteriors of a unit's plan; `complete`: with what the spec omits."""
    alone = complete is built
    fit, answers = posterior_and_answers(complete, known if alone else None)
    columns = unseen_columns(complete, answers)
    own = widened(fit, columns) if alone else own_of_imu(built, known)
    columns |= _another_run(complete.spec, complete.model)
    return CountedPosteriors(own, complete, fit, columns, alone)


def budget_of_estimate(built: BuiltImu, known: Posterior, done: EstimatedRun, noise: Columns) -> CountedPosteriors:
    """The posteriors of an estimate. `noise`: of `omitted_noise_of_imu`."""
    complete = with_typical(built.spec)
    own, whole = (unseen_columns(built, done.answers, spec, done) for spec in (built.spec, complete))
    columns = {**whole, **noise, **_another_run(complete, built.model)}
    return CountedPosteriors(widened(known, own), built, known, columns, not absent_terms(built.spec))


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
    variance = np.sum((reported @ budget.judged("this run").spread) ** 2, axis=1)
    rows: list[UnseenError] = []
    for name, columns in budget.counted("this run").items():
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
