"""Regressors from samples: the same integrals as the prediction's, taken over what was measured.

    Φ_k = Σ ψ(T_i) dt_i  (bias),   Σ ψ(T_i, ω_i)·ω_i dt_i  (scale factor),   T at the end less T at the start  (dB/dṪ)

over the rows of piece k, of a temperature without its thermometer's steps (`estimate.temperature`). The rate is the
table's where it is known well enough at every row. Otherwise it is the sensor's own, *corrected by the map that is
being estimated*: the two are found in turn, and since a wrong map of size M makes a regressor wrong by M of itself,
each round gains a factor of about M.

**Noisy rates** (errors in variables). A rate with the variance σ² makes the mean of `g(ω̃) = ψ(ω̃)·ω̃` exceed `g(ω)` by
½σ²g''(ω) + …; the mean of `½[g(ω̃+σ) + g(ω̃−σ)]` exceeds that of `g(ω̃)` by the same, so

    2 g(ω̃) − ½[g(ω̃+σ) + g(ω̃−σ)]

has no error to that order (none at all for maps up to the square of the rate), and is what is summed. What the noises
of a regressor and its reading have in common is N²/(ω²t) of a turn of length t: nothing beside the rest.
"""

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.errormodel import GyroModel, Map
from gradcal_jax.estimation.bases import basis_values, beyond
from gradcal_jax.plans import Timeline

_ROWS_AT_ONCE = 1 << 16
# A noise of the rate so small beside the fastest one does not show in float64.
_NO_NOISE = 1e-8
# Of the largest rate: a change that is rounding; and how often a rate is substituted at most.
_SETTLED_RATE, _SUBSTITUTIONS = 1e-15, 50


def increments_of_samples(
    model: GyroModel,
    rate_rad_per_s: np.ndarray,
    temperature_c: np.ndarray,
    step_s: np.ndarray,
    rows: np.ndarray,
    moving: np.ndarray,
    broken: np.ndarray,
    *,
    rate_noise: float = 0.0,
) -> np.ndarray:
    """What each parameter's unit adds to the integrated error over each piece, `(P, p)`, rad.

    `rate_rad_per_s`, `temperature_c` and `step_s` (time since the row before) `(n,)`; `rows` `(P + 1,)`, `moving` and
    `broken` `(P,)` as in `executed`; `rate_noise`: standard deviation of a row's rate, rad/s. Pieces that do not move
    have no scale-factor columns, and broken ones none at all.
    """
    columns = model.columns
    count = len(moving)
    result = np.zeros((count, columns.count))
    if model.has_gradient:
        ends = temperature_c[rows]
        result[:, columns.gradient] = np.where(broken, 0.0, np.diff(ends))[:, None]
    begin = int(rows[0]) + 1
    piece_ends = rows[1:]
    while begin <= rows[-1]:
        end = min(begin + _ROWS_AT_ONCE, int(rows[-1]) + 1)
        # Every row's piece: the first whose end is not before the row.
        piece = np.searchsorted(piece_ends, np.arange(begin, end), side="left")
        if model.bias is not None:
            at, weight = temperature_c[begin:end], step_s[begin:end, None]
            _add(result, columns.bias, piece, basis_values(model.bias.temperature, at) * weight)
            _add(result, columns.bias_discrepancy, piece, beyond(model.bias, at, at) * weight)
        if model.scale is not None:
            turning = moving[piece] & ~broken[piece]
            if turning.any():
                which = np.flatnonzero(turning) + begin
                weight = step_s[which, None]
                values, outside = _scale_values(model.scale, temperature_c[which], rate_rad_per_s[which], rate_noise)
                _add(result, columns.scale, piece[turning], values * weight)
                _add(result, columns.scale_discrepancy, piece[turning], outside * weight)
        begin = end
    result[broken] = 0.0
    return result


def _add(result: np.ndarray, where: slice, piece: np.ndarray, values: np.ndarray) -> None:
    """Sum values over the rows of each piece, which are neighbours."""
    if where.stop == where.start or not len(piece):
        return
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    result[piece[starts], where] += np.add.reduceat(values, starts, axis=0)


def _scale_values(of: Map, temperature: np.ndarray, rate: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    by_basis = of.rate
    assert by_basis is not None

    def driven(w: np.ndarray) -> np.ndarray:
        return basis_values(by_basis, w) * w[:, None]

    by_rate = driven(rate)
    if noise > _NO_NOISE * float(np.max(np.abs(rate), initial=0.0)):
        by_rate = 2.0 * by_rate - 0.5 * (driven(rate + noise) + driven(rate - noise))
    at_temperature = basis_values(of.temperature, temperature)
    values = (at_temperature[:, :, None] * by_rate[:, None, :]).reshape(len(rate), -1)
    return values, beyond(of, temperature, rate) * rate[:, None]


def columns_at_readings(
    timeline: Timeline, model: GyroModel, increments: np.ndarray, turned: np.ndarray | None = None
) -> np.ndarray:
    """Increments `(P, p)` summed to the regressors at the readings, from the origin or the latest gap on; with the
    harmonics of the encoder at the table's angles (`turned` `(P,)`, or the timeline's own).
    """
    rows = np.cumsum(increments, axis=0)
    orders = model.reference.harmonic_orders
    if orders:
        angle = np.cumsum(np.asarray(timeline.turned()) if turned is None else turned)
        phase = angle[:, None] * np.asarray(orders, float)[None]
        waves = np.stack([1.0 - np.cos(phase), -np.sin(phase)], axis=-1).reshape(len(rows), -1)
        rows[:, model.columns.harmonics] = waves
    return since_gap(rows, timeline.gap_pieces.values)


def since_gap(values: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Running sums `(P, …)`, counted from the end of the latest gap piece."""
    if not len(gaps):
        return values
    latest = np.searchsorted(gaps, np.arange(len(values)), side="right") - 1
    origin = values[gaps[np.maximum(latest, 0)]]
    origin[latest < 0] = 0.0
    return values - origin


def integrated_error(
    rate_rad_per_s: np.ndarray,
    step_s: np.ndarray,
    angle_rad: np.ndarray | None,
    rows: np.ndarray,
    broken: np.ndarray,
    gaps: np.ndarray,
    known_rate: float = 0.0,
) -> np.ndarray:
    """`(P,)`: the sensor's integrated rate less the table's angle, and less a rate that is known (the Earth's), rad."""
    inside = slice(int(rows[0]) + 1, int(rows[-1]) + 1)
    starts = _starts(rows)
    not_empty = np.diff(rows) > 0
    sums = np.where(not_empty, np.add.reduceat((rate_rad_per_s[inside] - known_rate) * step_s[inside], starts), 0.0)
    if angle_rad is not None:
        sums = sums - np.diff(angle_rad[rows])
    sums = np.where(broken, 0.0, sums)
    return since_gap(np.cumsum(sums), gaps)


def _starts(rows: np.ndarray) -> np.ndarray:
    """Where each piece's rows begin, counted from the first row after the origin; empty pieces repeat a place."""
    last = int(rows[-1] - rows[0]) - 1
    return np.minimum(rows[:-1] - rows[0], max(last, 0))


def true_rate(
    model: GyroModel, parameters: np.ndarray, rate_rad_per_s: np.ndarray, temperature_c: np.ndarray
) -> np.ndarray:
    """The rates `(n,)` that the sensor's maps, as estimated, make of its own: the ω with ω̃ − B(T) = (1 + M(T, ω))·ω.

    Substituted into itself until it no longer changes: each time gains a factor of about M + ω·∂M/∂ω, some two digits
    for a map of a per cent. A map so wild that it never settles (over 100 %) is left after the last substitution.
    """
    columns = model.columns
    result = np.empty_like(rate_rad_per_s)
    for begin in range(0, len(rate_rad_per_s), _ROWS_AT_ONCE):
        part = slice(begin, begin + _ROWS_AT_ONCE)
        measured, temperature = rate_rad_per_s[part], temperature_c[part]
        if model.bias is not None:
            measured = measured - basis_values(model.bias.temperature, temperature) @ parameters[columns.bias]
        rate = measured
        scale = model.scale
        if scale is not None and scale.rate is not None:
            at_temperature = basis_values(scale.temperature, temperature)
            table = parameters[columns.scale].reshape(scale.temperature.size, scale.rate.size)
            close = _SETTLED_RATE * float(np.max(np.abs(measured), initial=0.0))
            for _ in range(_SUBSTITUTIONS):
                before = rate
                rate = measured / (
                    1.0 + formulas.scale_factor_map(at_temperature, basis_values(scale.rate, rate), table)
                )
                if np.max(np.abs(rate - before), initial=0.0) <= close:
                    break
        result[part] = rate
    return result
