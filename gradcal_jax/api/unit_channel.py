"""The estimate of one axis of one unit: smoothness, robust weights and tests, on converged columns."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax import estimation
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.fitted_lag import Lag
from gradcal_jax.api.log_rows import Rows, temperature_followed
from gradcal_jax.display import summary
from gradcal_jax.estimation import Estimate, Observations, Smoothness, StructureTest, Whitened
from gradcal_jax.information import noise_steps
from gradcal_jax.model import SCALE_FACTOR, Discrepancy, SensorModel

# Steps to which the ranges of a calibration are rounded, outwards.
_TEMPERATURE_STEP_K, _RATE_STEP_RAD_PER_S = 0.1, float(np.radians(0.1))


class UnitChannel(NamedTuple):
    """The estimate of one axis of one unit; `observations`, `estimate` and `white` are of this unit alone."""

    axis: str
    unit: str
    model: SensorModel
    observations: Observations
    estimate: Estimate
    white: Whitened
    consistency: estimation.Consistency
    weights: np.ndarray
    """`(n,)`, Huber's, of the readings used; 1: full weight."""
    lag_s: float
    lag_std_s: float | None
    smoothness: Smoothness | None
    valid_temperature_c: tuple[float, float]
    valid_rate_rad_per_s: tuple[float, float]
    counts: dict[str, int]
    """Numbers of rows used and left out, by reason; they add up to the rows read."""
    messages: tuple[str, ...]
    neighbours: tuple[estimation.Group, ...] = ()
    structure: tuple[StructureTest, ...] = ()
    """One test for every polynomial map."""
    not_valid: tuple[str, ...] = ()
    """What the record shows that makes the calibration not valid, by name."""

    __repr__ = summary


class Recorded(NamedTuple):
    """The rows of one axis of one unit and the motion executed in them; numbers of rows, and messages so far."""

    axis: str
    unit: str
    rows: Rows
    done: estimation.Executed
    counts: dict[str, int]
    messages: Sequence[str]


def finished_channel(
    recorded: Recorded,
    model: SensorModel,
    observations: Observations,
    white: Whitened,
    options: Options,
    fitted_lag: tuple[float, float | None],
    hidden: Sequence[tuple[Discrepancy, float, np.ndarray]],
) -> UnitChannel:
    """The estimate of one unit: smoothness, robust weights and tests, on converged columns.

    `fitted_lag` s, with its standard deviation where it was fitted. `hidden`: the tested functions beyond a map's
    structure, the false-alarm level, and their whitened columns `(n, k)`.
    """
    axis, unit, rows, done, counts, earlier = recorded
    (lag, lag_std), messages, smoothness = fitted_lag, list(earlier), None
    if options.smoothness == "auto":
        smoothness = estimation.choose_smoothness(white, model)
        model = estimation.with_smoothness(model, smoothness.bias, smoothness.scale_factor)
        white = white._replace(prior=model.prior_rows())
        if smoothness.at_edge:
            messages.append("the data do not determine the smoothness of the maps: it is at the edge of its range")
    structure = [
        estimation.structure_test(white.without(model.where(term.name)), columns, term, level)
        for term, level, columns in hidden
    ]
    estimate = estimation.solve(white)
    weights = np.ones(white.data.shape[1])
    if options.robust:
        estimate, white, weights = estimation.estimate_robustly(observations, model, threshold=options.threshold)
        messages += counting_less(weights, observations.time_s[observations.used])
    # An error that never changes is common to both parts of the data: it is no noise when they are compared.
    constant = noise_steps(done.line, _with_changing_noise(model))
    compared = estimation.whitened(observations, model, constant) if not options.robust else white
    subsets = _subsets(observations, rows)
    tests = estimation.consistency(estimate, white, 0, subsets, model.to_reported, compared=compared)
    messages += Lag(lag, lag_std).doubts
    integrated = integrated_rows(done, len(rows.time))
    inside = rows.temperature[integrated]
    groups: tuple[estimation.Group, ...] = ()
    if options.neighbours_k is not None:
        groups, sentences = _neighbours(model, observations, estimate, rows, done, options.neighbours_k)
        messages += sentences
    ranges = covered_temperatures(inside), _fastest(model, estimate, rows, lag, integrated)
    sentences, structure_tests = tuple(dict.fromkeys(messages)), tuple(test for test in structure if test is not None)
    return UnitChannel(
        axis, unit, model, observations, estimate, white, tests, weights, lag, lag_std, smoothness, *ranges, counts,
        sentences, groups, structure_tests,
    )  # fmt: skip


def _with_changing_noise(model: SensorModel) -> SensorModel:
    """The model without its constant processes, such as the error of the sample clock."""
    p = model.processes
    changes = (p.decay != 0.0) | (p.diffusion != 0.0)
    return eqx.tree_at(lambda m: m.processes.initial_std, model, np.where(changes, p.initial_std, 0.0))


def counting_less(weights: np.ndarray, time_s: np.ndarray, names: Sequence[str] = ()) -> list[str]:
    """A sentence on the readings with the smallest robust weights; `names`: the channel of each reading."""
    low = np.argsort(weights)[: np.count_nonzero(weights < 1.0)]
    if not len(low):
        return []
    named = ", ".join(f"{f'{names[k]} ' if names else ''}at {time_s[k]:.6g} s" for k in low[:5])
    return [f"{len(low)} of {len(weights)} readings have less than full weight, the least {named}"]


def _neighbours(
    model: SensorModel,
    observations: Observations,
    estimate: Estimate,
    rows: Rows,
    done: estimation.Executed,
    width_k: float,
) -> tuple[tuple[estimation.Group, ...], list[str]]:
    """The mean scale factor of moves at nearly one temperature, without a structure, beside the map's."""
    if done.line.rates or rows.angle is None or model.scale is None:
        return (), ["there are no moves between two rests with a known angle, so there are no neighbours to group"]
    scale = model.where(SCALE_FACTOR)
    moves = estimation.moves_between_rests(
        observations.readings[:, 0],
        observations.columns_of(0)[:, scale] @ estimate.parameters[0][scale],
        np.diff(rows.angle[done.rows]),
        np.diff(rows.time[done.rows]),
        observations.temperature_c,
        done.line.moving,
        done.broken,
    )
    groups = estimation.closest_neighbours(moves, width_k)
    messages = [] if groups else ["no move has a rest right before and after it, so there are no neighbours"]
    return groups, messages


def _fastest(
    model: SensorModel, estimate: Estimate, rows: Rows, lag: float, integrated: np.ndarray
) -> tuple[float, float]:
    """Slowest and fastest true rate of the integrated rows in motion, rad/s; zero without any."""
    turning = ~rows.standing & rows.usable & integrated
    if rows.angle is None or not turning.any():
        return 0.0, 0.0
    rates = estimation.true_rate(
        model, estimate.parameters[0], rows.rate[turning], temperature_followed(rows, lag)[turning]
    )
    return covered_rates(rates)


def covered_temperatures(temperature_c: np.ndarray) -> tuple[float, float]:
    """The lowest and the highest temperature, °C."""
    return _outwards(float(temperature_c.min()), float(temperature_c.max()), _TEMPERATURE_STEP_K)


def covered_rates(rates: np.ndarray) -> tuple[float, float]:
    """The slowest and the fastest rate, rest included, rad/s."""
    return _outwards(min(float(rates.min()), 0.0), max(float(rates.max()), 0.0), _RATE_STEP_RAD_PER_S)


def _outwards(low: float, high: float, step: float) -> tuple[float, float]:
    """The range, rounded outwards to whole steps."""
    return float(np.floor(low / step + 1e-6) * step), float(np.ceil(high / step - 1e-6) * step)


def integrated_rows(done: estimation.Executed, count: int) -> np.ndarray:
    """`(count,)`: the rows whose samples were integrated."""
    return estimation.within(done.rows, ~done.broken, count)


def _subsets(observations: Observations, rows: Rows) -> dict[str, np.ndarray]:
    """Divisions of the readings into two parts whose estimates should agree."""
    used = observations.used
    time = observations.time_s[used]
    result: dict[str, np.ndarray] = {}
    minute = np.interp(time + 30.0, rows.time, rows.temperature) - np.interp(time - 30.0, rows.time, rows.temperature)
    heating, cooling = minute > 0.05, minute < -0.05
    if heating.sum() > 0.1 * len(time) and cooling.sum() > 0.1 * len(time):
        result["heating against cooling"] = minute > 0.0
    turning = observations.rate_rad_per_s[used] != 0.0
    moves = np.cumsum(np.diff(turning, prepend=False) & turning)
    if moves.max(initial=0) >= 4:
        result["odd moves against even ones"] = moves % 2 == 1
    if len(time) >= 4:
        result["first half against second"] = time < 0.5 * (time[0] + time[-1])
    return result
