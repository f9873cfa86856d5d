"""Measured samples as nodes of the model's terms, and the readings.

The regressors are the prediction's own terms (`model.terms`), summed over the rows of each piece, at a smoothed
temperature (`estimation.temperature`). The rate is the table's where it is accurate enough at every row. Otherwise it
is the sensor's own, *corrected by the estimated map*: map and rate are computed in turn, and since a map error M causes
a relative error M of a regressor, each round gains a factor of about M. (The terms correct for the noise of the rate.
The correlation of a regressor's noise with that of its reading is N²/(ω²t) for a turn of duration t, which is
negligible.)
"""

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.information import since_origin
from gradcal_jax.model import BIAS, SCALE_FACTOR, Nodes, SampleNodes, SensorModel

_ROWS_AT_ONCE = 1 << 16
# Change of a rate, relative to the largest one, that is rounding; largest number of substitutions.
_SETTLED_RATE, _SUBSTITUTIONS = 1e-15, 50


def sample_nodes(
    rate_rad_per_s: np.ndarray,
    temperature_c: np.ndarray,
    step_s: np.ndarray,
    rows: np.ndarray,
    moving: np.ndarray,
    broken: np.ndarray,
    turned: np.ndarray,
    *,
    rate_noise: float = 0.0,
) -> Nodes:
    """A log's samples as nodes of `P` pieces.

    `rate_rad_per_s`, `temperature_c` and `step_s` (time since the row before) `(n,)`; `rows` `(P + 1,)`, `moving` and
    `broken` `(P,)` as in `executed`; `turned` `(P,)`: angle of the table, rad; `rate_noise`: standard deviation of a
    row's rate, rad/s. Pieces that do not move have no rate, and broken ones no samples at all.
    """
    lengths = np.diff(rows)
    groups = []
    for moves in (False, True):
        chosen = np.flatnonzero((moving == moves) & ~broken & (lengths > 0))
        # Pieces are grouped to some ten thousand rows, since their products are large.
        share = np.cumsum(lengths[chosen]) // _ROWS_AT_ONCE
        for pieces in np.split(chosen, np.flatnonzero(np.diff(share)) + 1):
            if not len(pieces):
                continue
            counts = lengths[pieces]
            starts = np.cumsum(counts) - counts
            at = np.repeat(rows[pieces] + 1 - starts, counts) + np.arange(int(counts.sum()))
            rate = rate_rad_per_s[at] if moves else np.zeros(len(at))
            groups.append(SampleNodes(pieces, starts, step_s[at], rate, temperature_c[at], rate_noise, moves))
    angle = np.cumsum(turned)
    change = np.where(broken, 0.0, np.diff(temperature_c[rows]))
    return Nodes(tuple(groups), change, angle - turned, angle)


def integrated_error(
    rate_rad_per_s: np.ndarray,
    step_s: np.ndarray,
    angle_rad: np.ndarray | None,
    rows: np.ndarray,
    broken: np.ndarray,
    gap: np.ndarray,
    known_rate: float = 0.0,
) -> np.ndarray:
    """`(P,)`: the sensor's integrated rate less the table's angle, less a known rate (the Earth's), rad."""
    inside = slice(int(rows[0]) + 1, int(rows[-1]) + 1)
    # First row of each piece, counted from the first row after the origin; empty pieces repeat an index.
    starts = np.minimum(rows[:-1] - rows[0], max(int(rows[-1] - rows[0]) - 1, 0))
    not_empty = np.diff(rows) > 0
    sums = np.where(not_empty, np.add.reduceat((rate_rad_per_s[inside] - known_rate) * step_s[inside], starts), 0.0)
    if angle_rad is not None:
        sums = sums - np.diff(angle_rad[rows])
    return since_origin(np.where(broken, 0.0, sums), gap)


def true_rate(
    model: SensorModel, parameters: np.ndarray, rate_rad_per_s: np.ndarray, temperature_c: np.ndarray
) -> np.ndarray:
    """The sensor's rates `(n,)` corrected by its estimated maps: the ω with ω̃ − B(T) = (1 + M(T, ω))·ω.

    By fixed-point iteration: each step gains a factor of about M + ω·∂M/∂ω, two digits for a map of one per cent. For a
    map without convergence (over 100 %) it ends after the last step.
    """
    result = np.empty_like(rate_rad_per_s)
    for begin in range(0, len(rate_rad_per_s), _ROWS_AT_ONCE):
        part = slice(begin, begin + _ROWS_AT_ONCE)
        measured, temperature = rate_rad_per_s[part], temperature_c[part]
        if model.bias is not None:
            measured = measured - model.bias.temperature(temperature) @ parameters[model.where(BIAS)]
        rate = measured
        scale = model.scale
        if scale is not None and scale.rate is not None:
            at_temperature = scale.temperature(temperature)
            table = parameters[model.where(SCALE_FACTOR)].reshape(scale.temperature.size, scale.rate.size)
            close = _SETTLED_RATE * float(np.max(np.abs(measured), initial=0.0))
            for _ in range(_SUBSTITUTIONS):
                before = rate
                rate = measured / (1.0 + formulas.scale_factor_map(at_temperature, scale.rate(rate), table))
                if np.max(np.abs(rate - before), initial=0.0) <= close:
                    break
        result[part] = rate
    return result
