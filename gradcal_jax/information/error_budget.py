"""The error budget: errors that no residual of a run shows, and the share of every error source in each residual.

Within one run the sample clock, the scale of an encoder, the cosine of a mounting, the offset of a thermometer or the
Earth's rate act as a constant of a map, or as its slope over temperature: the data fit as well with them as without,
and the estimate is off by a direction `v` of the parameters times the error. Each is therefore no parameter, but a
column of the posterior's spread: the covariance is `C + Σ v vᵀ`, for predictions and estimates.

`θ` of the input axis against the table's, each of two angles with standard deviation σ, multiplies the scale factor by
`cos θ ≈ 1 − (θ₁² + θ₂²)/2`, whose root mean square is √2 σ². The Earth's rate along an axis of unknown direction is
rectangular within ±15.04 deg/h (GUM, 4.3.7).
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.calibration import UnseenError
from gradcal_jax.design.criteria import Criterion
from gradcal_jax.information import Posterior, estimator_of_means, imu_system, noise_parts, statistic
from gradcal_jax.information.budget import Sensitivity, information_lost, sensitivity_of, weights_of
from gradcal_jax.information.gears import BACKLASH, SCALE_OF_ANGLE, apart_from_gears
from gradcal_jax.information.imu_residual import RequiredQuantity, quantity_of
from gradcal_jax.information.posterior import noise_of_sums
from gradcal_jax.information.residual import Contrasts
from gradcal_jax.information.verdicts import mission_weights
from gradcal_jax.model import (
    BIAS,
    SCALE_FACTOR,
    TEMPERATURE_GRADIENT,
    ChannelKind,
    Discrepancy,
    Hysteresis,
    ImuModel,
    Map,
    SignalMap,
)
from gradcal_jax.model.imu_build import BuiltImu, build_imu, imu_posterior, unweighted_estimator
from gradcal_jax.motion import EARTH_RATE, Trajectory, Turns, turns_of
from gradcal_jax.spec.absent import absent_terms, slopes_of, with_typical
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.requirement import MisalignmentRequirement, Requirement
from gradcal_jax.spec.spec_sections import Spec

TURN_ON: Final = "turn-on bias"
OFF_THERMOMETER: Final = "offset of the temperature"
CLOCKS: Final = "clocks that contradict each other"
BESIDE_THE_AXIS: Final = "misalignment of the input axis from the table's axis"
UNKNOWN_EARTH_RATE: Final = EARTH_RATE / 3.0**0.5
# Temperatures at which the slope of a map is taken, and the step of the difference, K.
_AT: Final = 64
_STEP_K: Final = 0.01
# Part of a run over which its ramp is measured, s.
_MINUTES: Final = 300.0
# Last parts of the keys of omitted terms that are no noise: columns of `columns_of`, or terms with parameters.
_NO_NOISE: Final = frozenset({
    "thermal_lag", "bias_temperature_gradient", "temperature_offset", "temperature_lag", "mounting_accuracy",
    "scale_error", "backlash", "turn_on_bias", "hysteresis", "scale_factor_hysteresis", "lever_arm",
})  # fmt: skip


class ChannelTerms(NamedTuple):
    """The terms of one channel with their places among all parameters; `kind`: "gyro" or "accelerometer"."""

    kind: str
    terms: tuple[tuple[slice, Map | SignalMap], ...]


class SystematicFigures(NamedTuple):
    """Standard deviations of the errors that no residual shows, SI: relative of the scale factor, by name, of the
    gyros; the offset (K) and lag (s) of the thermometer; the backlash of the table (rad); of biases, by kind: constant,
    per K/s, and new at every power-on. `slopes`: typical ones of bias and scale factor over temperature, by kind.
    `hysteresis`: by kind and name of the map, half of what heating and cooling differ by."""

    scale: Mapping[str, float]
    offset: float
    lag: float
    backlash: float
    bias: Mapping[str, float]
    gradient: Mapping[str, float]
    turn_on: Mapping[str, float]
    slopes: Mapping[str, tuple[float, float]]
    hysteresis: Mapping[tuple[str, str], float] = MappingProxyType({})


class EstimatedRun(NamedTuple):
    """An estimate in the place of a plan: its parameters `(p,)`, the range of temperature of its data (°C), and the
    standard deviation of its lag (s) beyond what the covariance contains (None: the spec's). `one_way`: the temperature
    never returns; `clock_doubt`: a ratio by which the log's clocks are apart."""

    parameters: np.ndarray
    temperature_c: tuple[float, float]
    ramp: float
    lag_std: float | None = None
    one_way: bool = False
    clock_doubt: float = 0.0


def systematic_figures(spec: Spec) -> SystematicFigures:
    """The figures that a spec names; what it does not name is zero."""
    sensor = spec.sensor
    gyro, table = spec.sensor.gyro, spec.rig.table
    common = {
        "offset": float(sensor.temperature_offset or 0.0),
        "lag": float(sensor.temperature_lag or 0.0),
        "backlash": max(float(axis.angle.backlash or 0.0) for axis in table.axis),
    }
    scales = [float(axis.angle.scale_error or 0.0) for axis in table.axis]
    triads = {"gyro": gyro, "accelerometer": spec.sensor.accelerometer}
    # A table of several axes sees the directions of the input axes.
    seen = len(table.axis) > 1 or (gyro is not None and gyro.misalignment is not None)
    mounting = 0.0 if seen else float(table.mounting[0].accuracy)
    return SystematicFigures(
        scale={BESIDE_THE_AXIS: 2.0**0.5 * mounting**2, SCALE_OF_ANGLE: max(scales)},
        bias={"Earth's rate": UNKNOWN_EARTH_RATE if spec.rig.site.is_unknown else 0.0},
        gradient={kind: triad.gradient_std for kind, triad in triads.items() if triad is not None},
        turn_on={kind: float(triad.turn_on_bias or 0.0) for kind, triad in triads.items() if triad is not None},
        slopes={kind: slopes_of(spec.sensor, kind) for kind, triad in triads.items() if triad is not None},
        hysteresis={
            (kind, name): float(np.hypot.reduce([float(p.prior) * float(p.width) for p in plays], initial=0.0))
            for kind, triad in triads.items()
            if triad is not None
            for name, plays in ((BIAS, triad.hysteresis), (SCALE_FACTOR, triad.scale_factor_hysteresis))
        },
        **common,
    )


def columns_of(
    figures: SystematicFigures,
    channels: Sequence[ChannelTerms],
    size: int,
    ramp: float,
    done: EstimatedRun | None = None,
    turns: Turns | None = None,
) -> dict[str, np.ndarray]:
    """Columns `(p, k)` of the spread by the name of their error, for `size` parameters and a `ramp` of that many K/s
    (root mean square). In a plan a map has its class's slopes, in an estimate its own. `turns`: without them backlash
    does not count."""
    columns: dict[str, list[np.ndarray]] = {}

    def add(name: str, column: np.ndarray) -> None:
        if np.any(column):
            columns.setdefault(name, []).append(column)

    for kind, terms in channels:
        if kind == "gyro":
            for name, std in figures.scale.items():
                add(name, std * _constants(terms, size, SCALE_FACTOR))
            for name, std in figures.bias.items():
                add(name, std * _constants(terms, size, BIAS))
            if figures.backlash and turns is not None:
                add(BACKLASH, figures.backlash * _by_backlash(terms, size, turns))
        for (own, name), size_of_it in figures.hysteresis.items():
            # A map from one branch is off by twice as much on the other as one from both.
            if own == kind and done is not None:
                add("hysteresis", size_of_it * (2.0 if done.one_way else 1.0) * _constants(terms, size, name))
        add("bias from dT/dt", figures.gradient[kind] * ramp * _constants(terms, size, BIAS))
        if done is None:
            by_name = dict(zip((BIAS, SCALE_FACTOR), figures.slopes[kind], strict=True))
            slope = sum((s * _constants(terms, size, name) for name, s in by_name.items()), np.zeros(size))
        else:
            slope = _slopes(terms, size, done)
        lag = figures.lag if done is None or done.lag_std is None else done.lag_std
        add(OFF_THERMOMETER, figures.offset * slope)
        add("lag of the temperature", lag * ramp * slope)
    return {name: np.stack(several, axis=1) for name, several in columns.items()}


def widened(known: Posterior, columns: Mapping[str, np.ndarray]) -> Posterior:
    """The posterior with further errors, each a set of columns `(p, k)`."""
    return known._replace(spread=np.concatenate([known.spread, *columns.values()], axis=1)) if columns else known


def another_run(figures: SystematicFigures, channels: Sequence[ChannelTerms], size: int) -> dict[str, np.ndarray]:
    """Columns for the bias of another power-on."""
    columns = [figures.turn_on[kind] * _constants(terms, size, BIAS) for kind, terms in channels]
    return {TURN_ON: np.stack(columns, axis=1)} if any(np.any(c) for c in columns) else {}


def _constants(terms, size: int, name: str) -> np.ndarray:
    """Parameters `(p,)` of the term that is 1 everywhere; zero without the term."""
    column = np.zeros(size)
    for where, term in terms:
        if term.name == name:
            column[where] = term.constant if isinstance(term, Map) else term.temperature.constant
    return column


def _by_backlash(terms, size: int, turns: Turns) -> np.ndarray:
    """Parameters `(p,)` of the scale factor by which turns seem larger than they are, each weighted with its size."""
    column = np.zeros(size)
    for where, term in terms:
        if term.name == SCALE_FACTOR and isinstance(term, Map):
            functions = np.asarray(term.values(turns.temperature_c, turns.rate)) * turns.size[:, None]
            column[where] = np.linalg.lstsq(functions, turns.lost * turns.size, rcond=1e-6)[0]
    return column


def _slopes(terms, size: int, done: EstimatedRun) -> np.ndarray:
    """Parameters `(p,)` of the estimated terms' derivatives in temperature, `(1/K)`, by least squares over the data's
    temperatures: exact for polynomials."""
    column = np.zeros(size)
    low, high = done.temperature_c
    at = np.linspace(low, max(high, low + 1.0), _AT)
    for where, term in terms:
        functions = term.temperature(at)
        change = (term.temperature(at + _STEP_K) - term.temperature(at - _STEP_K)) / (2.0 * _STEP_K)
        # A map over rate is a tensor product, temperature first.
        own = done.parameters[where].reshape(functions.shape[1], -1)
        column[where] = np.linalg.lstsq(functions, change @ own, rcond=None)[0].ravel()
    return column


def ramp_of(lines: Sequence[Trajectory]) -> float:
    """Root mean square of dT/dt over the data that are used, K/s."""
    total, time = 0.0, 0.0
    for line in lines:
        kept = ~np.asarray(line.gap)
        lasting, slope, excess = (np.asarray(of)[kept] for of in (line.duration, line.slope, line.excess))
        # ∫(slope − a·e^(−λt))² dt over each piece, a = λ·excess
        rate = float(line.lag_rate)
        faded = -np.expm1(-rate * lasting)
        square = slope**2 * lasting - 2.0 * slope * excess * faded + 0.5 * rate * excess**2 * faded * (2.0 - faded)
        total += float(np.sum(square))
        time += float(np.sum(lasting))
    return (total / time) ** 0.5 if time else 0.0


def ramp_of_record(time: np.ndarray, temperature: np.ndarray) -> float:
    """Root mean square of dT/dt of a record (s, °C), over parts of five minutes, K/s."""
    span = float(time[-1] - time[0])
    if span <= 0.0:
        return 0.0
    at = np.linspace(time[0], time[-1], max(2, round(span / _MINUTES) + 1))
    return float(np.sqrt(np.mean((np.diff(np.interp(at, time, temperature)) / np.diff(at)) ** 2)))


def terms_of_imu(built: BuiltImu) -> list[ChannelTerms]:
    """The maps and terms of every channel of a unit."""
    model, channels = built.model, []
    for c in model.channels:
        own = [(model.where(c.kind, c.axis, t.name), t) for t in c.model.terms if isinstance(t, Map | SignalMap)]
        channels.append(ChannelTerms(c.kind, tuple(own)))
    return channels


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
    columns: Mapping[str, np.ndarray] = MappingProxyType({})

    def judged(self, run: str) -> Posterior:
        """What a verdict judges in "any run" or in "this run"."""
        return self.any_run if run == "any run" else self.whole


def budget_of_imu(built: BuiltImu, known: Posterior, complete: BuiltImu) -> CountedPosteriors:
    """The posteriors of a unit's plan; `complete`: with what the spec omits."""
    fit = known if complete is built else imu_posterior(complete)
    turn_on = another_run(systematic_figures(complete.spec), terms_of_imu(complete), complete.model.size)
    every = columns_of_imu(complete)
    own = widened(known, every) if complete is built else own_of_imu(built, known)
    whole = own if fit is known else widened(fit, every)
    return CountedPosteriors(own, whole, widened(whole, turn_on), complete, fit, every | turn_on)


def own_of_imu(built: BuiltImu, known: Posterior) -> Posterior:
    """The posterior of a unit's plan with what the spec names."""
    return widened(known, columns_of_imu(built))


def columns_of_imu(built: BuiltImu) -> dict[str, np.ndarray]:
    """Columns of what no residual of a plan's run shows, as far as the spec names it."""
    ramp = ramp_of([built.motion.line])
    figures = _without_fitted(systematic_figures(built.spec), built)
    turns = turns_of(built.motion) if figures.backlash else None
    return columns_of(figures, terms_of_imu(built), built.model.size, ramp, turns=turns)


def _without_fitted(figures: SystematicFigures, built: BuiltImu) -> SystematicFigures:
    """A sensitivity to dT/dt or a hysteresis that the model estimates is in its covariance, and so are the errors of
    gears."""
    fitted, (scales, lashes) = _fitted(built.model), np.reshape(built.gears, (-1, 2)).T
    scale = dict(figures.scale) | ({SCALE_OF_ANGLE: 0.0} if np.any(scales) else {})
    backlash = 0.0 if np.any(lashes) else figures.backlash
    gradient = {kind: 0.0 if kind in fitted else std for kind, std in figures.gradient.items()}
    hysteresis = {of: 0.0 if of in fitted else std for of, std in figures.hysteresis.items()}
    return figures._replace(scale=scale, backlash=backlash, gradient=gradient, hysteresis=hysteresis)


def _fitted(of: ImuModel) -> set[Any]:
    """The kinds of channels whose sensitivity to dT/dt is estimated, and the kinds and maps whose hysteresis is."""
    fitted: set[Any] = {c.kind for c in of.channels if c.model.term(TEMPERATURE_GRADIENT) is not None}
    for c in of.channels:
        plays = [term for term in c.model.terms if isinstance(term, Hysteresis)]
        fitted |= {(c.kind, SCALE_FACTOR if term.signals else BIAS) for term in plays}
    return fitted


def budget_of_estimate(
    built: BuiltImu, known: Posterior, done: EstimatedRun, noise: Mapping[str, np.ndarray]
) -> CountedPosteriors:
    """The posteriors of an estimate. `noise`: of `omitted_noise_of_imu`."""
    both = [_without_fitted(systematic_figures(s), built) for s in (built.spec, with_typical(built.spec))]
    named, complete = (of._replace(scale={**of.scale, CLOCKS: done.clock_doubt}) for of in both)
    size, terms = built.model.size, terms_of_imu(built)
    turns = turns_of(built.motion) if complete.backlash else None
    own, whole = (columns_of(figures, terms, size, done.ramp, done, turns) for figures in (named, complete))
    turn_on = another_run(complete, terms, size)
    left = widened(known, own)
    columns = {**whole, **noise}
    counted = widened(known, columns) if absent_terms(built.spec) else left
    return CountedPosteriors(left, counted, widened(counted, turn_on), built, known, columns)


# Share of a coefficient's variance below which a column is left out of a file.
_NEGLIGIBLE: Final = 1e-4


def counted_criterion(criterion: Criterion, built: BuiltImu) -> Criterion:
    """The criterion of a single gyro's parameters with what no residual shows and the spec names: no plan removes it,
    so that it is a part of the variance from the beginning."""
    rows, maps = np.asarray(criterion.rows), slice(sum(t.size for t in built.model.terms if isinstance(t, Map)))
    more = sum(np.sum((rows[:, maps] @ c[maps]) ** 2, axis=1) for c in columns_of_imu(built).values())
    return eqx.tree_at(lambda c: c.beyond, criterion, criterion.beyond + more)


def floor_of_plan(spec: Spec) -> tuple[BuiltImu, Posterior]:
    """What no residual of any plan shows, as far as the spec names it, as a posterior of its own, and its model."""
    built = build_imu(spec)
    nothing = np.zeros((built.model.size, 0))
    # Longer turns lose less to backlash.
    columns = {name: column for name, column in columns_of_imu(built).items() if name != BACKLASH}
    return built, widened(Posterior(nothing, nothing), columns)


def shares_of_variance(
    budget: CountedPosteriors, run: str, statistic_of: Callable[[Posterior], float]
) -> tuple[float, dict[str, float]]:
    """The share of noise and priors in the variance of a statistic, and those of what no residual shows, by name; they
    add up to one."""
    columns = {n: c for n, c in budget.columns.items() if run == "any run" or n != TURN_ON}
    total = statistic_of(widened(budget.fit, columns)) ** 2
    if not (np.isfinite(total) and total > 0.0):
        return 1.0, {}
    without = {n: statistic_of(widened(budget.fit, {m: c for m, c in columns.items() if m != n})) for n in columns}
    parts = {name: 1.0 - value**2 / total for name, value in without.items()}
    of_fit = statistic_of(budget.fit) ** 2 / total
    whole = of_fit + sum(parts.values())
    return of_fit / whole, {name: part / whole for name, part in parts.items()}


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
    spec's own plan."""
    noisy = noise_completed(built.spec)
    if noisy is built.spec:
        return {}
    plan, more = (imu_posterior(of) for of in (built, build_imu(noisy)))
    return {"omitted noise": _excess(plan, more, built.model.size, built.model.calibrated)}


def noise_completed(spec: Spec) -> Spec:
    """The spec with the omitted terms that are noise, or parameters of the table, at typical figures; without those
    that change the parameters of the sensor or the temperatures of the plan."""
    noise = {t.key: t.value for t in absent_terms(spec) if t.key.rpartition(".")[2] not in _NO_NOISE}
    return changed(spec, noise) if noise else spec


def _excess(spec: Posterior, noisy: Posterior, size: int, own: int) -> np.ndarray:
    """Columns `(p, k)` of what the omitted noise adds to the covariance of the first `own` parameters."""
    more = noisy.spread[:own] @ noisy.spread[:own].T - spec.spread[:own] @ spec.spread[:own].T
    scale = np.sqrt(np.maximum(np.diag(noisy.spread[:own] @ noisy.spread[:own].T), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(more / np.outer(scale, scale))
    columns = np.zeros((size, own))
    columns[:own] = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return columns


PRIOR: Final = "prior knowledge"
DISCREPANCY: Final = "model discrepancy"
# Sources of the installation's parameters, by the beginning of their names.
_INSTALLATION: Final[Mapping[str, str]] = {
    "angle_": "encoder's error by angle",
    "sample_clock": "sample clock",
    "gravity": "gravity",
    "tilt": "tilt of the base",
    "azimuth": "azimuth of the base",
    "orthogonality": "angles between the table's axes",
    "mounting": "mounting",
}
_WHITE: Final[Mapping[ChannelKind, str]] = {"gyro": "angle random walk", "accelerometer": "velocity random walk"}
_ENCODER: Final[Mapping[str, Callable[[ImuModel], Any]]] = {
    "rate accuracy": lambda m: m.encoder.rate,
    "reading noise": lambda m: m.encoder.reading,
    "standstill offset": lambda m: m.encoder.offset,
    "timing error": lambda m: m.encoder.timing,
}
# Share of the whole below which the rest is rounding, not prior knowledge.
_ROUNDING = 5e-3


class ErrorBudget:
    """The error sources of a plan; `shares` of a requirement are `∂ ln s / ∂ ln σ` of its statistic s."""

    def __init__(self, built: BuiltImu, known: Posterior) -> None:
        self.built, self.known = built, known
        motion, model, nodes = built.motion, built.model, built.body_nodes()
        steps, columns = imu_system(motion, model, nodes)
        models = {name: _only(built, name) for name in _active_sources(built)}
        parts = noise_parts(motion, models, nodes, steps) if models else {}
        own, names = model.calibrated, model.names()
        self._unweighted = unweighted_estimator(built.spec)
        self._sources: dict[str, Float[np.ndarray, "p p"]] = {}
        stds = np.concatenate([np.zeros(0), *(np.asarray(term.stds) for term in model.installation)])
        if self._unweighted:
            estimator = estimator_of_means(motion, model, steps, columns)
            back = np.pad(estimator.back, [(0, model.size - own), (0, 0)])
            for name, part in parts.items():
                self._sources[name] = back @ noise_of_sums(part, estimator.weights) @ back.T
            shared = back @ (estimator.weights.T @ columns[:, own:]) * stds
            for k, name in enumerate(names[own:]):
                self._add(_source_of(name), np.outer(shared[:, k], shared[:, k]))
            return
        if built.gears:
            columns, of_gears = apart_from_gears(motion, model, nodes, built.gears)
            for name, row in of_gears:
                self._add(name, np.outer(row, row))
        self._sources |= information_lost(steps, np.asarray(columns), parts)
        for k, name in enumerate(names[own:], own):
            of_prior = np.zeros((model.size, model.size))
            of_prior[k, k] = stds[k - own] ** -2.0
            self._add(_source_of(name), of_prior)
        for c in model.channels:
            for term in c.model.terms:
                if isinstance(term, Discrepancy):
                    of_prior, rows = np.zeros((model.size, model.size)), np.asarray(term.prior_rows())
                    where = model.where(c.kind, c.axis, term.name)
                    of_prior[where, where] = rows.T @ rows
                    self._add(DISCREPANCY, of_prior)

    def _add(self, name: str, part: Float[np.ndarray, "p p"]) -> None:
        self._sources[name] = self._sources.get(name, 0.0) + part

    def shares(self, requirement: Requirement) -> dict[str, float] | None:
        """The share of every source in a requirement's statistic, the largest first; None where the plan cannot observe
        it. The residual is homogeneous of degree one in all standard deviations together, so the shares add up to one;
        the rest after all sources is that of the priors."""
        quantity = quantity_of(self.built, requirement)
        total, slope, beside = _slope_of(quantity, self.known)
        if not np.isfinite(total) or total <= 0.0:
            return None
        of = slope.of_covariance if self._unweighted else -slope.of_gram
        budget = {name: 2.0 * float(np.sum(of * part)) for name, part in self._sources.items()}
        if DISCREPANCY in budget:
            budget[DISCREPANCY] += 2.0 * slope.of_beyond
        if beside:
            name = "mounting" if isinstance(requirement, MisalignmentRequirement) else "bias from dT/dt"
            budget[name] = budget.get(name, 0.0) + 2.0 * beside
        budget = {name: value / total for name, value in budget.items()}
        rest = 1.0 - sum(budget.values())
        if abs(rest) > _ROUNDING:
            budget[PRIOR] = rest
        return dict(sorted(budget.items(), key=lambda item: -item[1]))


def _slope_of(quantity: RequiredQuantity, known: Posterior) -> tuple[float, Sensitivity, float]:
    """The statistic of a quantity (SI), its derivatives, and the part of what stands beside, half its derivative in
    the logarithm of that."""
    requirement, size = quantity.requirement, len(known.spread)
    found = quantity.residual(known)
    weight = mission_weights(requirement, requirement.statistic)
    values = found.values / found.si * weight
    each = np.array([statistic(requirement.statistic, of) for of in values])
    total = float(np.sqrt(np.mean(each**2)) if requirement.axis == "all" else np.max(each))
    nothing = Sensitivity(np.zeros((size, size)), np.zeros((size, size)), 0.0)
    if not np.isfinite(total) or total <= 0.0:
        return total, nothing, 0.0
    outer = each / (total * len(each)) if requirement.axis == "all" else np.arange(len(each)) == np.argmax(each)
    slope, beside = nothing, 0.0
    for element, own, of in zip(quantity.elements, outer, values, strict=True):
        of_value = (own * weights_of(requirement.statistic, of)).ravel()
        counts = of_value > 0.0
        if not np.any(counts):
            continue
        # d value = weight² · d variance / (2 value)
        of_variance = 0.5 * (np.broadcast_to(weight, of.shape).ravel() ** 2 * of_value)[counts] / of.ravel()[counts]
        part = Posterior(known.spread[element.where], known.hidden[element.where])
        states = element.states()
        worst = np.argmax([state.left(part) for state in states], axis=0) if len(states) > 1 else np.zeros(of.size, int)
        for k in np.unique(worst[counts]):
            here = counts & (worst == k)
            rows, alone, beyond = (np.asarray(x)[here] for x in states[k])
            places = Contrasts(_widened(rows, element.where, size), _widened(alone, element.where, size), beyond)
            more = sensitivity_of(known, places, of_variance[here[counts]])
            slope = slope.plus(more)
        beside += float(np.sum(of_variance)) * quantity.beside**2
    return total, slope, beside


def _widened(rows: np.ndarray, where: slice, size: int) -> np.ndarray:
    """Rows of some parameters as rows of all."""
    wide = np.zeros((len(rows), size))
    wide[:, where] = rows
    return wide


def _source_of(parameter: str) -> str:
    """The error source of an installation's parameter."""
    return next(source for begin, source in _INSTALLATION.items() if parameter.startswith(begin))


def source_name(kind: ChannelKind, process: str) -> str:
    """The name of a process of one kind of channel as an error source."""
    return process if kind == "gyro" else f"accelerometer {process}"


def _active_sources(built: BuiltImu) -> list[str]:
    """Names of the noise sources that are not zero and act on this plan."""
    model, line = built.model, built.motion.line
    white = {c.kind for c in model.channels if _is_there(c.model.angle_random_walk)}
    names = [name for kind, name in _WHITE.items() if kind in white]
    unread = {"reading noise", "standstill offset", "timing error"} if line.rates else {"rate accuracy"}
    if model.encoder.held or not len(line.moving_pieces):
        unread.add("timing error")
    names += [name for name, of in _ENCODER.items() if name not in unread and _is_there(of(model))]
    return names + [source_name(kind, name) for kind, of in built.sources.items() for name in of]


def _is_there(figure: Any) -> bool:
    return bool(np.any(np.asarray(figure) > 0.0))


def _only(built: BuiltImu, source: str) -> ImuModel:
    """The model with one noise source alone."""
    model = built.model
    for k, c in enumerate(model.channels):
        processes = c.model.processes
        sizes = np.zeros(processes.count)
        for name, members in built.sources[c.kind].items():
            sizes[list(members)] = float(source_name(c.kind, name) == source)
        parts = (
            c.model.angle_random_walk * float(_WHITE[c.kind] == source),
            processes.initial_std * sizes,
            processes.diffusion * sizes,
        )
        of = lambda m, k=k: (  # noqa: E731
            m.channels[k].model.angle_random_walk,
            m.channels[k].model.processes.initial_std,
            m.channels[k].model.processes.diffusion,
        )
        model = eqx.tree_at(of, model, parts)
    for name, field in _ENCODER.items():
        model = eqx.tree_at(field, model, np.asarray(field(model)) * float(name == source))
    return model


def limited_by(shares: Mapping[str, float] | None, axis: str | None = None) -> str | None:
    """The error sources with the largest shares, in words; of the worst `axis`, where there are several."""
    where = None if axis is None else f"axis {axis}"
    if not shares:
        return where
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    words = ", ".join(f"{name} {share:.0%}" for name, share in largest)
    return words if where is None else f"{where}: {words}"
