"""The standard method: rate errors at stable temperatures, from a log or a table of points."""

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.api.build import Assembled
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.log_rows import Rows, count_rows, temperature_followed
from gradcal_jax.api.tested_maps import hidden_maps
from gradcal_jax.api.unit_channel import (
    Recorded,
    UnitChannel,
    covered_rates,
    covered_temperatures,
    finished_channel,
    integrated_rows,
)
from gradcal_jax.estimation import Estimate, Observations
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.points import RatePoints
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.information import least_squares, noise_steps, unweighted
from gradcal_jax.trajectory import Trajectory, held


def standard_channel(built: Assembled, log: Log, axis: str, unit: int, rows: Rows, options: Options) -> UnitChannel:
    """The estimate of one unit from the plan's points in a log. Raises `LogError` without a reference rate."""
    schedule = built.spec.schedule
    assert isinstance(schedule, StandardSchedule)
    planned = np.asarray(schedule.rates, float)
    table_rate = rows.table_rate
    if table_rate is None:
        if np.any(planned != 0.0):
            raise LogError("the log has no table rate, which is the reference of the standard method")
        table_rate = np.zeros(len(rows.time))
    points = estimation.plateaus(
        rows.time,
        rows.temperature,
        table_rate,
        rows.usable,
        np.asarray(schedule.temperatures, float),
        planned,
        float(schedule.integration),
        points=schedule.shared,
    )
    messages = [*rows.messages, *points.sentences]
    done = points.done
    counts = count_rows(log, unit, integrated_rows(done, len(log.time_s)))
    return _of_points(built, Recorded(axis, log.units[unit], rows, done, counts, messages), table_rate, options)


def point_channel(built: Assembled, points: RatePoints, options: Options) -> UnitChannel:
    """The estimate from a table of points, each of the plan's integration time. Raises `LogError` for other plans.

    Points are independent except for the reference's error; their noise is their own σ or, without it, the spec's.
    """
    schedule = built.spec.schedule
    if not isinstance(schedule, StandardSchedule):
        raise LogError('a table of points is of the standard method: give a spec with method = "standard"')
    count = len(points.output_rad_per_s)
    if count < 2:
        raise LogError(f"{points.source}: {count} points are too few")
    before = lambda x: np.concatenate([x[:1], x])  # noqa: E731
    time = float(schedule.integration) * np.arange(count + 1)
    reference, temperature = before(points.reference_rad_per_s), before(points.temperature_c)
    nothing, usable = np.zeros(count + 1, bool), np.arange(count + 1) > 0
    rows = Rows(
        time, np.diff(time, prepend=0.0), before(points.output_rad_per_s), temperature, None, reference, nothing,
        nothing, np.ones(count + 1), usable, np.zeros(1, np.int64), (),
    )  # fmt: skip
    every, none = np.ones(count, bool), np.zeros(count, bool)
    line = held(
        time[:-1], np.diff(time), points.reference_rad_per_s, points.temperature_c, points.temperature_c, read=every,
        at_rest=none, moving=every, gap=none, rates=True, points="independent",
    )  # fmt: skip
    done = estimation.Executed(line, np.arange(count + 1), none)
    messages = [
        "the points' order and times are not known: each has independent noise by the spec, and errors that they share "
        "(the clock, the turn-on bias) are not in the covariance"
    ]
    if points.sigma_rad_per_s is not None:
        messages = ["the points' own sigma replaces the spec's noise; errors that the points share are not in it"]
    recorded = Recorded(points.axis, points.unit, rows, done, {"used": count}, messages)
    return _of_points(built, recorded, reference, options, points.sigma_rad_per_s)


def _of_points(
    built: Assembled, recorded: Recorded, table_rate: np.ndarray, options: Options, sigma: np.ndarray | None = None
) -> UnitChannel:
    model, rows, (line, edges, broken) = built.model, recorded.rows, recorded.done
    lag = 0.0 if options.lag == "fit" else float(options.lag)
    temperature_of_maps = temperature_followed(rows, lag)
    if options.lag == "fit":
        sentence = "at stable temperatures a lag cannot be estimated: it is taken as zero"
        recorded = recorded._replace(messages=[*recorded.messages, sentence])
    nodes = estimation.sample_nodes(
        table_rate, temperature_of_maps, rows.step, edges, line.moving, broken, np.zeros(len(broken))
    )
    error = np.where(rows.usable, rows.rate - table_rate - (options.earth_rate or 0.0), 0.0) * rows.step
    readings = np.where(broken, 0.0, np.diff(np.cumsum(error)[edges]))[:, None]
    mean_rate, time = line.terms[:, 0], rows.time[edges[1:]]
    observations = Observations(noise_steps(line, model), model.columns(nodes), readings, time, line.level, mean_rate)
    if sigma is not None:
        own = observations.steps
        observations = observations._replace(
            steps=own._replace(
                transition=np.zeros_like(own.transition),
                covariance=np.zeros_like(own.covariance),
                initial=np.zeros_like(own.initial),
                reading_variance=own.reading_variance + (sigma * line.duration) ** 2,
            )
        )
    white = estimation.whitened(observations, model)
    hidden = [
        (term, level, estimation.whitened_columns(observations._replace(columns=term.columns(nodes)))[0])
        for term, level in hidden_maps(built.spec, model)
    ]
    channel = finished_channel(recorded, model, observations, white, options, (lag, None), hidden)
    section = built.spec.plan
    if sigma is None and isinstance(section, StandardPlanSection) and section.estimator == "least squares":
        channel = channel._replace(estimate=_unweighted(channel, line))
    return channel._replace(
        valid_temperature_c=covered_temperatures(line.level[~broken]),
        valid_rate_rad_per_s=covered_rates(mean_rate[~broken]),
    )


def _unweighted(channel: UnitChannel, line: Trajectory) -> Estimate:
    """Ordinary least squares on the points' mean rate errors, as the paper's figure; priors are not used."""
    observations = channel.observations
    estimator = least_squares(line, channel.model, observations.columns_of(0))
    beta = estimator.back @ (estimator.weights.T @ observations.readings[:, 0])
    residuals = channel.white.data[0] - channel.white.rows[0] @ beta
    return channel.estimate._replace(
        parameters=beta[None], known=(unweighted(line, channel.model),), residuals=residuals[None]
    )
