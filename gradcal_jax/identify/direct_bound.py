"""Direct Bound: the Gauss-Markov drift that bounds a record at rest, as an alternative to an Allan fit.

Source: Z. Berman, "Inertial Sensors - A New Approach for Low Cost Calibration and Testing", section 3, eqs. 6-10.

Given the angle random walk N and the data's `D_θ*(t)` (`largest_drift`), a process (σ, τ) bounds them with the margin
k when `D_θ*(t) ≤ k D_L(t; σ, τ)` at every t, with the D_L of the data's alignment, a plain mean over Δ
(`limiting_function_of_mean`). The smallest σ for a τ is a closed form,

    σ²(τ) = max_t [(D_θ*(t)² - κ(t)² N² (1/t + 1/Δ)) / (k² g(t, Δ, τ))]₊          κ = k in the paper

and the curve σ(τ) is the feasible boundary, the limit of all bounding pairs. The choice of a pair on it is not the
paper's: the *tightest bound over the range*, with the least mean over ln t of `ln(limit / D_θ*)`, which is nowhere
negative on the boundary.

**Why κ.** The largest of very many draws of pure random walk exceeds k = 2.5 standard deviations, too (ten hours
contain 36 000 integrations over a second), and with κ = k that excess appears as drift: the result for a sensor without
drift is 14 deg/h. So κ is the level of the largest draw of random walk in a record of this length, where that is more
than k. Under random walk alone D(t₀) is a stationary Gaussian process in t₀ with autocorrelation `1 - C|h|`, `C = (1/t²
+ 1/Δ² + 1/(tΔ)) / (1/t + 1/Δ)`, because its kernel jumps by 1/t, 1/t + 1/Δ and 1/Δ; the probability that its largest
magnitude over T seconds of starts exceeds u standard deviations is (J. Pickands, "Upcrossing probabilities for
stationary Gaussian processes", 1969; the 1 is the first start, and n starts are no more than n draws)

    P ≈ 1 - exp(-2 min(1 + T C u², n) Φ(-u))

and κ(t) = max(k, u(t)), with the P of each t such that a record of pure random walk is within the limit at every t with
probability 95 %. `raise_margin=False` gives the paper's κ = k.

**Significance of the drift.** If D_θ* is within κ N √(1/t + 1/Δ) at every t, no drift is significant: the result is σ =
0, with a message that states how large a drift could be hidden and from which Δ on it would be significant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int
from scipy import optimize, special

from gradcal_jax.identify.largest_drift import LargestDrift
from gradcal_jax.identify.limiting_function import (
    drift_shape_of_mean,
    limiting_function_of_mean,
    random_walk_variance_of_mean,
)

Times = Float[np.ndarray, " times"]
Taus = Float[np.ndarray, " taus"]
# Probability that a record of pure random walk shows a drift.
_CHANCE_OF_FALSE_DRIFT = 0.05


@dataclass(frozen=True)
class DirectBound:
    """The drift process (σ, τ) that bounds one channel, and the boundary of all pairs (σ, τ) that do. Rates are in the
    unit of the record (rad/s)."""

    drift_std: float
    """σ of the chosen pair; zero if the angle random walk alone is a bound."""
    correlation_time_s: float
    """τ of the chosen pair."""
    angle_random_walk: float
    """Angle random walk N that was assumed, rad/√s."""
    margin: float
    """k: the data stay within k standard deviations of the bounding process."""
    averaging_time_s: float
    """Averaging time Δ before the drift is measured, s."""
    integration_time_s: Times
    largest_drift: Times
    """Largest drift D_θ*(t) in the record."""
    limiting_function: Times
    """Limiting function D_L(t) of the chosen pair, one standard deviation."""
    limit: Times
    """The limit √(κ² N² (1/t + 1/Δ) + k² σ² g), which is k D_L if κ = k; it is nowhere below `largest_drift`."""
    random_walk_limit: Times
    """The limit by the angle random walk alone, κ N √(1/t + 1/Δ)."""
    boundary_correlation_time_s: Taus
    boundary_drift_std: Taus
    """The boundary σ(τ): a pair on it or above it is a bound."""
    boundary_excess: Taus
    """For each pair of the boundary, the mean over ln t of ln(limit / D_θ*)."""
    deciding_time_s: float
    """Integration time t at which the limit of the chosen pair touches the data."""
    deciding_start_index: int
    """First sample of the drift that decides the bound, after its average over Δ."""
    drift_shows: bool
    """Whether D_θ*(t) exceeds the limit of the angle random walk anywhere."""
    hidden_drift_std: float
    """If no drift is visible: the largest σ that a hidden drift with τ = √(Δ × longest t) could have; this τ is
    `correlation_time_s`."""
    advised_averaging_time_s: float | None
    """If no drift is visible: the smallest Δ at which this hidden drift would be visible; `None`: none, for these t."""
    messages: tuple[str, ...]
    """Warnings for the user; empty without any."""


def smallest_bounding_variance(
    integration_time_s: Float[ArrayLike, " times"],
    largest_drift: Float[ArrayLike, " times"],
    averaging_time_s: ArrayLike,
    angle_random_walk: ArrayLike,
    correlation_time_s: Float[ArrayLike, " taus"],
    *,
    margin: ArrayLike = 2.5,
    random_walk_margin: Float[ArrayLike, " times"] | None = None,
) -> Float[np.ndarray, " taus"]:
    """σ²(τ) of the feasible boundary, in the square of the rates' unit; zero where random walk alone bounds.

    `random_walk_margin` is κ(t); without it κ = k as in the paper. A closed form.
    """
    t, drift, tau = (np.asarray(x) for x in (integration_time_s, largest_drift, correlation_time_s))
    walk = random_walk_variance_of_mean(t, averaging_time_s, angle_random_walk)
    granted = (margin if random_walk_margin is None else np.asarray(random_walk_margin)) ** 2 * walk
    shape = drift_shape_of_mean(t[:, None], averaging_time_s, tau[None, :])
    return np.maximum(np.max(((drift**2 - granted) / margin**2)[:, None] / shape, axis=0), 0.0)


def largest_of_random_walk(
    integration_time_s: Times,
    averaging_time_s: float,
    start_count: Int[np.ndarray, " times"],
    sample_interval_s: float,
    *,
    exceeded_with_probability: float,
) -> Times:
    """The level, in standard deviations, that the largest drift of pure random walk exceeds with some probability.

    By the asymptotic formula at the module's head, accurate to a few per cent of the level for probabilities up to 0.5.
    Zero where every level has a lower probability.
    """
    if not 0 < exceeded_with_probability < 1:
        raise ValueError(f"a probability must lie between 0 and 1, and this one is {exceeded_with_probability}")
    t, delta = integration_time_s, averaging_time_s
    crossings = (1 / t**2 + 1 / delta**2 + 1 / (t * delta)) / (1 / t + 1 / delta) * start_count * sample_interval_s
    log_expected = float(np.log(-np.log1p(-exceeded_with_probability)))

    def beyond(u: Float[np.ndarray, "#levels times"]) -> Float[np.ndarray, "levels times"]:
        # ln Φ keeps its digits where Φ itself underflows.
        return np.log(2.0 * np.minimum(1.0 + crossings * u**2, start_count)) + special.log_ndtr(-u) - log_expected

    # Bisection on the branch that falls with u; the asymptotic formula does not hold below its maximum.
    grid = np.broadcast_to(np.linspace(0.0, 3.0, 61)[:, None], (61, len(t)))
    crest = np.argmax(beyond(grid), axis=0)
    low, high = grid[crest, np.arange(len(t))].copy(), np.full(len(t), 100.0)
    reached = beyond(low[None])[0] > 0
    for _ in range(60):
        middle = (low + high) / 2
        above = beyond(middle[None])[0] > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(reached, (low + high) / 2, 0.0)


def fit_direct_bound(
    observed: LargestDrift,
    angle_random_walk: float,
    *,
    margin: float = 2.5,
    raise_margin: bool = True,
    rate_in_words: Callable[[float], str] = "{:.3g} in the unit of the rates".format,
) -> DirectBound:
    """The feasible boundary of a channel and the tightest pair on it.

    **Arguments:** `observed` from `largest_drift`; `angle_random_walk` N, rad/√s (from an Allan fit or a data sheet;
    too large an N hides drift, too small an N appears as drift); `margin` k; `raise_margin`: whether κ is raised to the
    largest draw of random walk in a record of this length (see the module's head); `rate_in_words` formats a rate for
    the messages (the core uses SI units only). The τ's extend from a third of the shortest t to ten times the longest,
    and the chosen one is refined between its neighbours.

    **Raises:** `ValueError` for numbers that are not positive.
    """
    t, delta = observed.integration_time_s, observed.averaging_time_s
    if not 0 < margin < np.inf:
        raise ValueError(f"the margin k must be positive, and this one is {margin}")
    if not 0 <= angle_random_walk < np.inf:
        raise ValueError(f"the angle random walk must be zero or more, and this one is {angle_random_walk}")
    largest = observed.largest_drift
    if largest.min() <= 0:
        raise ValueError("the rate is constant, so there is no drift to bound")
    tau = np.geomspace(t[0] / 3, 10 * t[-1], 201)
    starts, interval = observed.start_count, observed.sample_interval_s
    # Divided among the times: maxima at times a factor √e apart are nearly independent.
    chance = _CHANCE_OF_FALSE_DRIFT / (1.0 + 2.0 * np.log(t[-1] / t[0]))
    level = largest_of_random_walk(t, delta, starts, interval, exceeded_with_probability=chance)
    walk_margin = np.maximum(margin, level) if raise_margin else np.full(len(t), margin)
    walk_limit = walk_margin * np.sqrt(random_walk_variance_of_mean(t, delta, angle_random_walk))
    weight = _log_weights(t)

    def boundary(taus: Taus) -> tuple[Taus, Taus]:
        variance, excess = _boundary(t, largest, delta, angle_random_walk, taus, margin, walk_margin, weight)
        return np.sqrt(variance), excess

    std, excess = boundary(tau)
    best = int(np.argmin(excess))
    chosen_tau = float(tau[best])
    shows = bool(np.any(largest > walk_limit))
    hidden, advised = 0.0, None
    messages: list[str] = []
    if not shows:
        low = largest_of_random_walk(t, delta, starts, interval, exceeded_with_probability=1.0 - chance)
        chosen_tau = float(np.sqrt(delta * t[-1]))
        hidden = _hidden_drift(t, largest, low, delta, angle_random_walk, chosen_tau)
        advised = _averaging_time_that_shows(t, delta, hidden, chosen_tau, angle_random_walk)
        mean_error = rate_in_words(angle_random_walk / float(np.sqrt(delta)))
        messages.append(_no_drift_shows(delta, mean_error, hidden, rate_in_words(hidden), chosen_tau, advised))
    elif 0 < best < len(tau) - 1:
        optimum: Any = optimize.minimize_scalar(
            lambda log_tau: float(boundary(np.exp(np.array([log_tau])))[1][0]),
            bounds=(np.log(tau[best - 1]), np.log(tau[best + 1])),
            method="bounded",
            options={"xatol": 1e-5},
        )
        if optimum.fun < excess[best]:
            chosen_tau = float(np.exp(optimum.x))
    else:
        messages.append(
            "the record does not determine the correlation time, because this time is longer than the longest "
            "integration time; only σ²/τ of the drift is bounded"
            if best > 0
            else "the record does not determine the correlation time, because this time is shorter than the shortest "
            "integration time; only σ²τ of the drift is bounded"
        )
    chosen_std = float(boundary(np.array([chosen_tau]))[0][0])
    drift_part = chosen_std**2 * drift_shape_of_mean(t, delta, chosen_tau)
    limit = np.sqrt(walk_limit**2 + margin**2 * drift_part)
    decides = int(np.argmax(largest / limit))
    return DirectBound(
        drift_std=chosen_std,
        correlation_time_s=chosen_tau,
        angle_random_walk=angle_random_walk,
        margin=margin,
        averaging_time_s=delta,
        integration_time_s=t,
        largest_drift=largest,
        limiting_function=np.asarray(limiting_function_of_mean(t, chosen_std, chosen_tau, angle_random_walk, delta)),
        limit=limit,
        random_walk_limit=walk_limit,
        boundary_correlation_time_s=tau,
        boundary_drift_std=std,
        boundary_excess=excess,
        deciding_time_s=float(t[decides]),
        deciding_start_index=int(observed.start_index[decides]),
        drift_shows=shows,
        hidden_drift_std=hidden,
        advised_averaging_time_s=advised,
        messages=tuple(messages),
    )


def _hidden_drift(t: Times, largest: Times, level: Times, delta: float, angle_random_walk: float, tau: float) -> float:
    """The largest σ for which D_θ* may be as small as these by chance; nearly every record exceeds `level`."""
    telling = level > 0  # at other t the record is too short and allows any drift
    if not telling.any():
        return np.inf
    walk = np.asarray(random_walk_variance_of_mean(t, delta, angle_random_walk))[telling]
    shape = drift_shape_of_mean(t[telling], delta, tau)
    possible = float(np.min(((largest[telling] / level[telling]) ** 2 - walk) / shape))
    return float(np.sqrt(max(possible, 0.0)))


def _no_drift_shows(
    delta: float, mean_error: str, hidden: float, hidden_words: str, tau: float, advised: float | None
) -> str:
    sentence = (
        f"averaged over {delta:g} s, the drift is not visible above the angle random walk; the random walk alone "
        f"gives the average an uncertainty of N/√Δ = {mean_error}"
    )
    if not np.isfinite(hidden):
        return sentence + "; the record is too short to state how large a hidden drift could be"
    if hidden == 0:
        return sentence + "; the angle random walk explains the whole record (or was assumed too large)"
    sentence += f"; a drift of up to {hidden_words} with a correlation time of {tau:.3g} s could be present"
    if advised is None:
        return (
            f"{sentence}; with these integration times, no averaging time would make such a drift visible: use longer "
            "integration times"
        )
    return sentence + f"; averaging over {advised:.3g} s or more would make such a drift visible"


def _boundary(
    t: Float[np.ndarray, " times"],
    largest: Float[np.ndarray, " times"],
    delta: ArrayLike,
    angle_random_walk: ArrayLike,
    taus: Float[np.ndarray, " taus"],
    margin: ArrayLike,
    walk_margin: Float[np.ndarray, " times"],
    weight: Float[np.ndarray, " times"],
) -> tuple[Float[np.ndarray, " taus"], Float[np.ndarray, " taus"]]:
    """(σ², mean excess) of the pairs on the boundary."""
    variance = smallest_bounding_variance(
        t, largest, delta, angle_random_walk, taus, margin=margin, random_walk_margin=walk_margin
    )
    walk = walk_margin**2 * random_walk_variance_of_mean(t, delta, angle_random_walk)
    drift = margin**2 * variance[None, :] * drift_shape_of_mean(t[:, None], delta, taus[None, :])
    return variance, weight @ (0.5 * np.log(walk[:, None] + drift) - np.log(largest)[:, None])


def _averaging_time_that_shows(
    t: Times, delta: float, std: float, tau: float, angle_random_walk: float
) -> float | None:
    """The shortest Δ beyond the present one for which, at some t, drift gives as much variance as the random walk."""
    if std <= 0:
        return None
    candidates = np.geomspace(delta, 100 * max(delta, t[-1]), 400)[1:]
    drift = std**2 * drift_shape_of_mean(t[:, None], candidates[None, :], tau)
    walk = random_walk_variance_of_mean(t[:, None], candidates[None, :], angle_random_walk)
    shows = np.any(drift >= walk, axis=0)
    return float(candidates[np.argmax(shows)]) if shows.any() else None


def _log_weights(t: Times) -> Times:
    """Trapezoid weights in ln t with sum one, so that the choice does not depend on the distribution of the times."""
    if len(t) == 1:
        return np.ones(1)
    step = np.diff(np.log(t))
    return (np.append(step, 0.0) + np.append(0.0, step)) / (2 * step.sum())
