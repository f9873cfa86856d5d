"""Information of a cycle that repeats on a temperature ramp, from a few of its cycles.

On one slope, cycles that end where they began differ in temperature only, and a polynomial at a shifted temperature is
a polynomial: the columns of cycle j are `C_j = C₁ S_j`, S_j one small matrix. The noise is stationary after one cycle,
so from the second to the last but one every cycle has the same map,

    rows_j = W S_j + V x_j,    x_{j+1} = E S_j + Ψ x_j                 x: the filter's state for every column

and one pass through the second cycle, with one more column for each state, gives W, V, E and Ψ. The first cycle, and
the last one with the readings after it, are filtered directly.
"""

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.whitening import FilterState, whiten_from

# Largest change of a state's variance from one cycle to the next, relative to its initial variance.
_SETTLED = 5e-3


def repeated_gram(
    steps: NoiseSteps, columns: Float[np.ndarray, "R p"], rows: int, shifts: Float[np.ndarray, "J p p"], degree: int
) -> Float[np.ndarray, "p p"] | None:
    """`Φᵀ V⁻¹ Φ` of J + 2 cycles of `rows` readings each, and of the readings after them.

    `steps`, `columns`: of the first three cycles and of the readings after the last. `shifts`: S of the second cycle
    (one), the third, and so on. `degree`: of S in the cycle's number, plus a few for the entering state.

    None where the noise is not stationary after one cycle, with correlation times of several cycles. Otherwise standard
    deviations agree with those of all cycles to 1e-3, and to about 1e-5 for correlation times below a cycle.
    """
    count, p = steps.initial.shape[0], columns.shape[1]
    beside = np.concatenate([np.zeros((count, p)), np.eye(count)], axis=1)
    wide = np.concatenate([columns, np.zeros((len(columns), count))], axis=1)

    def through(covariance, first: int, last: int | None):
        part = slice(first, last)
        cut = NoiseSteps(*(x if x is None or x is steps.initial else x[part] for x in steps))
        whitened, end = whiten_from(FilterState(beside, covariance), cut, wide[part])
        return whitened.T @ whitened, end.mean[:, :p], end.mean[:, p:], end.covariance

    first, entering, _, covariance = through(steps.initial, 0, rows)
    every, own, onward, after = through(covariance, rows, 2 * rows)
    known = np.diag(steps.initial)
    if np.any(np.abs(np.diag(after - covariance)) > _SETTLED * np.where(known > 0.0, known, np.inf)):
        return None
    last, *_ = through(after, 2 * rows, None)
    driven = own @ shifts
    entries = np.concatenate([shifts, np.empty((len(shifts), count, p))], axis=1)
    for entry, drive in zip(entries, driven, strict=True):
        entry[p:] = entering
        entering = drive + onward @ entering
    # The entries are polynomials of few terms in the cycle's number: orthonormal coefficients carry the sum over
    # cycles.
    basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, len(shifts)), degree + 1))[0]
    few = np.reshape(basis.T @ entries.reshape(len(entries), -1), (-1, p + count, p))
    end = np.concatenate([shifts[-1], entering])
    return first[:p, :p] + np.sum(few.swapaxes(1, 2) @ (every @ few), axis=0) + end.T @ last @ end
