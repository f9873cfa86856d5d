"""Files to core objects and back: the one module that knows both.

`assemble(spec)` builds the error model and the plan; `predict` and `timeline` fill the contracts that other programs read.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gradcal_jax import errormodel, plans
from gradcal_jax.errormodel import GyroModel, Map, Processes
from gradcal_jax.files import Prediction, Spec
from gradcal_jax.files.bases import RatePolynomial, RateSpline, TemperaturePolynomial, TemperatureSpline
from gradcal_jax.files.contracts import ParameterRow, RequirementRow
from gradcal_jax.files.moves import ResolvedMove
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.schedule import GradientSchedule, StandardSchedule
from gradcal_jax.files.sensor import Bias, ScaleFactor, Sensor
from gradcal_jax.information import (
    STATISTICS,
    Posterior,
    SquareRootInformation,
    information,
    parameter_names,
    posterior,
    residual,
    statistic,
    to_reported,
    unobservable_combinations,
    unweighted,
)

PPM = 1e6
DEG_PER_H = 3600.0 * 180.0 / np.pi
DEG_PER_S = 180.0 / np.pi
UNIT_OF = {"scale_factor": ("ppm", PPM), "bias": ("deg/h", DEG_PER_H)}

# A varying rate is integrated on the nodes of a piece, against exponentials of at most this many correlation times.
_CORRELATION_TIMES_A_PIECE = 3.0


class Assembled(NamedTuple):
    """A spec in the core's terms. `sources`: what the model's noise consists of, by the names that people use."""

    spec: Spec
    model: GyroModel
    plan: plans.Plan
    thermal_lag: float | None
    sources: dict[str, tuple[int, ...]]

    @property
    def channels(self) -> tuple[str, ...]:
        """Sensor axes whose calibration the plan is for."""
        return self.plan.channels


def assemble(spec: Spec) -> Assembled:
    """Error model and plan of a spec."""
    processes, sources = _processes(spec.sensor)
    return Assembled(spec, _model(spec, processes), _plan(spec), _number(spec.sensor.thermal_lag), sources)


# --- model ------------------------------------------------------------------------------------------------------------


def _processes(sensor: Sensor) -> tuple[Processes, dict[str, tuple[int, ...]]]:
    """All noise processes of a sensor, and which of them belong to which source."""
    parts: list[tuple[str, Processes]] = [
        ("bias instability", errormodel.gauss_markov(float(d.standard_deviation), float(d.correlation_time)))
        for d in sensor.drift
    ]
    if sensor.rate_random_walk:
        parts.append(("rate random walk", errormodel.rate_random_walk(float(sensor.rate_random_walk))))
    for d in sensor.scale_factor_instability:
        process = errormodel.gauss_markov(
            float(d.standard_deviation), float(d.correlation_time), bias_gain=0.0, rate_gain=1.0
        )
        parts.append(("scale-factor instability", process))
    if (error := sensor.temperature_error) is not None:
        gains = {"bias_gain": float(error.bias_slope or 0.0), "rate_gain": float(error.scale_factor_slope or 0.0)}
        deviation = float(error.standard_deviation)
        if error.correlation_time is None:
            parts.append(("temperature measurement", errormodel.constant(deviation, **gains)))
        else:
            process = errormodel.gauss_markov(deviation, float(error.correlation_time), **gains)
            parts.append(("temperature measurement", process))
    if sensor.sample_clock_error:
        parts.append(("sample clock", errormodel.constant(float(sensor.sample_clock_error), rate_gain=1.0)))
    if sensor.turn_on_bias and sensor.bias is None:
        parts.append(("turn-on bias", errormodel.constant(float(sensor.turn_on_bias), bias_gain=1.0)))
    total = errormodel.no_processes()
    sources: dict[str, tuple[int, ...]] = {}
    for name, part in parts:
        sources[name] = (*sources.get(name, ()), total.count)
        total = total + part
    return total, sources


def _model(spec: Spec, processes: Processes) -> GyroModel:
    sensor, table = spec.sensor, spec.rig.table
    gradient = sensor.bias_temperature_gradient
    angle = table.angle
    reference = errormodel.angle_reference(
        float(angle.reading_noise),
        float(angle.standstill_offset),
        float(angle.timing_error),
        float(table.rate_accuracy or 0.0),
        {h.order: float(h.amplitude) for h in angle.harmonics},
    )
    return GyroModel(
        None if sensor.bias is None else bias_map(sensor.bias),
        None if sensor.scale_factor is None else scale_factor_map(sensor.scale_factor),
        jnp.asarray(float(sensor.angle_random_walk)),
        processes,
        reference,
        jnp.asarray(float(sensor.turn_on_bias or 0.0)),
        jnp.asarray(np.inf if gradient is None or gradient.prior is None else float(gradient.prior)),
        has_gradient=gradient is not None,
        has_gradient_prior=gradient is not None and gradient.prior is not None,
    )


def basis(section) -> errormodel.Basis:
    """A basis of the core from its section of a spec."""
    if isinstance(section, TemperaturePolynomial | RatePolynomial):
        return errormodel.Polynomial(section.degree, float(section.centre), float(section.scale), section.internal)
    if isinstance(section, TemperatureSpline | RateSpline):
        return errormodel.BSpline(tuple(float(k) for k in section.knots), section.degree)
    return errormodel.Bins(tuple(float(e) for e in section.edges))


def bias_map(section: Bias) -> Map:
    """`B(T)` with its priors, from a spec."""
    beyond = section.discrepancy
    return errormodel.make_map(
        basis(section.temperature),
        prior_std=_or_infinite(section.prior),
        smoothness_std=_or_infinite(section.smoothness),
        discrepancy=None if beyond is None else (float(beyond.standard_deviation), beyond.temperature_degree, 0),
    )


def scale_factor_map(section: ScaleFactor) -> Map:
    """`M(T, ω)` with its priors, from a spec."""
    beyond = section.discrepancy
    return errormodel.make_map(
        basis(section.temperature),
        basis(section.rate),
        prior_std=_or_infinite(section.prior),
        smoothness_std=_or_infinite(section.smoothness),
        discrepancy=None
        if beyond is None
        else (float(beyond.standard_deviation), beyond.temperature_degree, beyond.rate_degree),
    )


def _or_infinite(value: float | None) -> float:
    return np.inf if value is None else float(value)


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


# --- plan -------------------------------------------------------------------------------------------------------------


def _plan(spec: Spec) -> plans.Plan:
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        return plans.standard_plan(schedule.temperatures, schedule.soak_each, schedule.integration, schedule.rates)
    programme = plans.programme(
        schedule.segments[0].temperature_start, [(segment.duration, segment.slope) for segment in schedule.segments]
    )
    ends = [segment.start for segment in schedule.segments] + [schedule.duration]
    nearest = lambda time: int(np.argmin(np.abs(np.array(ends) - time)))  # noqa: E731
    used = tuple((nearest(s.start), nearest(s.start + s.duration)) for s in schedule.stretches)
    cycle = schedule.cycle
    if cycle is None:
        return plans.gradient_plan(programme, used=used, read_every=schedule.read_every)
    longest = _CORRELATION_TIMES_A_PIECE * shortest_correlation_time(spec.sensor)
    moves = tuple(
        _move(move, cycle.other_read_every, longest) for move in cycle.moves for _ in range(move.repeat)
    )
    after = []
    if cycle.other > 0.0:
        after.append(plans.rest(cycle.other, cycle.other_read_every))
    if cycle.idle > 0.0:
        after.append(plans.rest(cycle.idle))
    return plans.gradient_plan(programme, moves, tuple(after), used=used, read_every=cycle.other_read_every)


def shortest_correlation_time(sensor: Sensor) -> float:
    """Of the processes that the rate drives (s); `inf` without any."""
    times = [float(d.correlation_time) for d in sensor.scale_factor_instability]
    if sensor.temperature_error is not None and sensor.temperature_error.correlation_time is not None:
        times.append(float(sensor.temperature_error.correlation_time))
    return min(times, default=np.inf)


def _move(move: ResolvedMove, others_read_every: float | None, longest_piece: float) -> plans.Move:
    if move.is_rest:
        return plans.rest(move.duration, move.read_every)
    return plans.turn(
        move.shape,
        move.peak_rate,
        move.duration,
        ramp=move.ramp,
        axis=move.axis,
        cycles=move.cycles,
        controls=move.controls,
        unevenness=move.unevenness,
        read_at_end=move.read_end,
        read_every=move.read_every,
        others_read_every=others_read_every,
        longest_piece=longest_piece,
    )


# --- prediction -------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def _information(plan: plans.Plan, model: GyroModel, channel: str, thermal_lag) -> SquareRootInformation:
    return information(plan.timeline(channel, thermal_lag), model)


def knowledge(built: Assembled, channel: str = "x", model: GyroModel | None = None) -> Posterior:
    """What is known after the plan, by the estimator that the spec names. `model` replaces the assembled one."""
    model = built.model if model is None else model
    lag = None if built.thermal_lag is None else jnp.asarray(built.thermal_lag)
    section = built.spec.plan
    if isinstance(section, StandardPlanSection) and section.estimator == "least squares":
        return unweighted(built.plan.timeline(channel, lag), model)
    return posterior(_information(built.plan, model, channel, lag))


def residual_map(built: Assembled, known: Posterior, requirement) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperatures (°C), rates (deg/s) and the residual `(n_T, n_ω)` in ppm or deg/h, on a requirement's box."""
    temperatures = np.linspace(*(float(t) for t in requirement.temperature), requirement.grid[0])
    rates = np.zeros(1)
    if requirement.quantity == "scale_factor":
        rates = np.linspace(*(float(r) for r in requirement.rate), requirement.grid[1])
    values = residual(known, built.model, requirement.quantity, temperatures, rates)
    return temperatures, rates * DEG_PER_S, values * UNIT_OF[requirement.quantity][1]


def predict(spec: Spec, *, limits: bool = False) -> Prediction:
    """The residual that a spec's plan leaves. `limits`: also say of each requirement what it is limited by."""
    built = assemble(spec)
    known = {channel: knowledge(built, channel) for channel in built.channels}
    requirements = [
        _requirement_row(built, known[channel], requirement, channel)
        for requirement in spec.requirement
        for channel in built.channels
    ]
    if limits:
        shares = {channel: error_shares(built, channel) for channel in built.channels}
        requirements = [
            row.model_copy(update={"limited_by": _limited_by(shares[row.axis].get(row.name))}) for row in requirements
        ]
    schedule = spec.schedule
    parameters, covariance = _parameters(built, known)
    return Prediction(
        title=spec.title,
        duration_s=schedule.duration,
        soak_s=schedule.soak,
        motion_s=schedule.motion,
        requirements=tuple(requirements),
        parameters=parameters,
        covariance=covariance,
        warnings=tuple(_warnings(built, known)),
    )


def unobservable(spec: Spec) -> list[str]:
    """One sentence for each combination of parameters that the plan cannot observe."""
    built = assemble(spec)
    return [s for channel in built.channels for s in _unobservable(built, channel, knowledge(built, channel))]


def _unobservable(built: Assembled, channel: str, known: Posterior) -> list[str]:
    where = f" on axis {channel}" if len(built.channels) > 1 else ""
    return [
        f"the plan cannot observe {combination}{where}: give it a prior, or change the plan"
        for combination in unobservable_combinations(known, built.model)
    ]


def _requirement_row(built: Assembled, known: Posterior, requirement, channel: str) -> RequirementRow:
    _, rates, values = residual_map(built, known, requirement)
    found = {name: statistic(name, values) for name in STATISTICS}
    if requirement.quantity == "bias":
        del found["mean of max"]
    found = {name: value if np.isfinite(value) else None for name, value in found.items()}
    unit, factor = UNIT_OF[requirement.quantity]
    target = None if requirement.target is None else float(requirement.target) * factor
    decisive = found[requirement.statistic]
    verdict = None
    if decisive is None:
        verdict = "unobservable"
    elif target is not None:
        verdict = "met" if decisive <= target else "missed"
    return RequirementRow(
        name=requirement.name,
        quantity=requirement.quantity,
        unit=unit,
        axis=channel,  # pyright: ignore[reportArgumentType]
        temperature_c=tuple(float(t) for t in requirement.temperature),
        rate_dps=(float(rates[0]), float(rates[-1])) if requirement.quantity == "scale_factor" else None,
        grid=tuple(requirement.grid),
        statistic=requirement.statistic,
        mean_of_max=found.get("mean of max"),
        max=found["max"],
        mean=found["mean"],
        rms=found["rms"],
        target=target,
        verdict=verdict,
    )


def _parameters(built: Assembled, known: dict[str, Posterior]):
    """Rows of the reported parameters and their covariance, axes one after the other (they are independent)."""
    model = built.model
    columns = model.columns
    count = columns.gradient.stop
    names, reported = parameter_names(model)[:count], to_reported(model)[:count]
    unit = ["rad/s"] * (columns.bias.stop - columns.bias.start) + ["1"] * (columns.scale.stop - columns.scale.start)
    unit += ["rad/K"] * (columns.gradient.stop - columns.gradient.start)
    rows, size = [], len(known) * count
    covariance: list[list[float | None]] = [[0.0] * size for _ in range(size)]
    for k, (channel, posterior_) in enumerate(known.items()):
        deviations = posterior_.deviations(reported)
        block = posterior_.covariance(reported)
        for i, deviation in enumerate(deviations):
            std = float(deviation) if np.isfinite(deviation) else None
            rows.append(ParameterRow(name=names[i], axis=channel, std=std, unit=unit[i]))  # pyright: ignore[reportArgumentType]
            for j, other in enumerate(deviations):
                seen = np.isfinite(deviation) and np.isfinite(other)
                covariance[k * count + i][k * count + j] = float(block[i, j]) if seen else None
    return tuple(rows), tuple(tuple(row) for row in covariance)


def _warnings(built: Assembled, known: dict[str, Posterior]) -> list[str]:
    spec, sensor = built.spec, built.spec.sensor
    found = [s for channel in built.channels for s in _unobservable(built, channel, known[channel])]
    line = built.plan.timeline(built.channels[0], built.thermal_lag)
    ends = np.asarray(line.temperature(jnp.broadcast_to(jnp.array([0.0, 1.0]), (line.piece_count, 2))))
    coldest, warmest = float(ends.min()), float(ends.max())
    fastest = max(_fastest(built.plan.timeline(c, built.thermal_lag)) for c in built.channels)
    for requirement in spec.requirement:
        low, high = (float(t) for t in requirement.temperature)
        if low < coldest - 1e-6 or high > warmest + 1e-6:
            found.append(
                f"requirement '{requirement.name}' asks for {low:g} … {high:g} °C, but the sensor goes through "
                f"{coldest:.4g} … {warmest:.4g} °C only: beyond that the structure of the maps is trusted"
            )
        if requirement.quantity == "scale_factor":
            widest = max(abs(float(r)) for r in requirement.rate)
            if widest > fastest * (1.0 + 1e-6):
                found.append(
                    f"requirement '{requirement.name}' asks for rates up to {widest * DEG_PER_S:.4g} deg/s, but the plan "
                    f"reaches {fastest * DEG_PER_S:.4g} deg/s only: beyond that the structure of the map is trusted"
                )
    if sensor.turn_on_bias and sensor.bias is not None:
        found.append(
            "within one run the turn-on bias cannot be told from a0: the bias map is this run's, and another run's differs by "
            f"{float(sensor.turn_on_bias) * DEG_PER_H:.4g} deg/h (standard deviation)"
        )
    schedule = spec.schedule
    if isinstance(schedule, GradientSchedule) and sensor.scale_factor is not None:
        plateaus = {round(m.peak_rate * DEG_PER_S, 6) for m in (schedule.cycle.moves if schedule.cycle else ()) if not m.is_rest}
        needed = sensor.scale_factor.rate.size
        ramped = all(m.shape in ("cosine ramps", "linear ramps") for m in (schedule.cycle.moves if schedule.cycle else ()) if not m.is_rest)
        if ramped and 0 < len(plateaus) <= needed:
            found.append(
                f"{len(plateaus)} distinct rates for {needed} coefficients in rate leave no freedom to notice a wrong model"
            )
    return found


def _fastest(line: plans.Timeline) -> float:
    """Largest rate of a timeline, rad/s, on a grid of each piece."""
    moving = line.moving_pieces.values
    if not len(moving):
        return 0.0
    grid = jnp.broadcast_to(jnp.linspace(0.0, 1.0, 33), (len(moving), 33))
    return float(jnp.max(jnp.abs(line.rate(grid, moving))))


# --- what limits a plan -----------------------------------------------------------------------------------------------

_STEP = 0.01


def error_shares(built: Assembled, channel: str = "x") -> dict[str, dict[str, float]]:
    """For each requirement, the share of every error source in its statistic: `∂ ln s / ∂ ln σ`, by central differences.

    The residual is homogeneous of degree one in all standard deviations together, so the shares add up to one; what the
    sources of noise leave is the priors' ("prior knowledge").
    """
    scaled = {
        name: (_with_source(built, name, 1.0 - _STEP), _with_source(built, name, 1.0 + _STEP))
        for name in active_sources(built)
    }
    values = {
        name: [_statistics(built, knowledge(built, channel, model)) for model in pair] for name, pair in scaled.items()
    }
    shares: dict[str, dict[str, float]] = {}
    for requirement in built.spec.requirement:
        key = requirement.name
        found = {}
        for name, (low, high) in values.items():
            if np.isfinite(low[key]) and np.isfinite(high[key]) and low[key] > 0.0:
                found[name] = float(np.log(high[key] / low[key]) / np.log((1.0 + _STEP) / (1.0 - _STEP)))
        if found:
            rest = 1.0 - sum(found.values())
            if abs(rest) > 5e-3:
                found["prior knowledge"] = rest
            shares[key] = dict(sorted(found.items(), key=lambda item: -item[1]))
    return shares


def active_sources(built: Assembled) -> list[str]:
    """Names of the error sources that are not zero."""
    model, reference = built.model, built.model.reference
    names = {"angle random walk": float(model.angle_random_walk)}
    if isinstance(built.plan, plans.StandardPlan):
        names["rate reference"] = float(reference.rate_accuracy)
    else:
        names |= {
            "reading noise": float(reference.reading_noise),
            "standstill offset": float(reference.standstill_offset),
            "timing": float(reference.timing_error) if any(True for _ in built.plan.moves) else 0.0,
            "angle error of the encoder": float(np.sum(np.asarray(reference.harmonic_amplitudes))),
        }
    return [name for name, value in names.items() if value > 0.0] + list(built.sources)


def _with_source(built: Assembled, name: str, factor: float) -> GyroModel:
    """The model with one error source scaled."""
    model = built.model
    if name in built.sources:
        factors = np.ones(model.processes.count)
        factors[list(built.sources[name])] = factor
        return eqx.tree_at(
            lambda m: (m.processes.initial_std, m.processes.diffusion),
            model,
            (model.processes.initial_std * factors, model.processes.diffusion * factors),
        )
    field = {
        "angle random walk": lambda m: m.angle_random_walk,
        "rate reference": lambda m: m.reference.rate_accuracy,
        "reading noise": lambda m: m.reference.reading_noise,
        "standstill offset": lambda m: m.reference.standstill_offset,
        "timing": lambda m: m.reference.timing_error,
        "angle error of the encoder": lambda m: m.reference.harmonic_amplitudes,
    }[name]
    return eqx.tree_at(field, model, field(model) * factor)


def _statistics(built: Assembled, known: Posterior) -> dict[str, float]:
    """The decisive statistic of each requirement."""
    return {r.name: statistic(r.statistic, residual_map(built, known, r)[2]) for r in built.spec.requirement}


def _limited_by(shares: dict[str, float] | None) -> str | None:
    if not shares:
        return None
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    return ", ".join(f"{name} {share:.0%}" for name, share in largest)
