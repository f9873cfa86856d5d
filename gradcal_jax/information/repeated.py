"""Information of a cycle that repeats while a unit's temperature runs straight, from a few of its cycles alone.

With T one slope and a cycle that ends where it began, cycles differ in temperature alone, and polynomials of it at
another temperature are polynomials: the columns of cycle j are `C_j = C₁ S_j`, S_j one small matrix. The noise has
settled after one cycle, so from the second to the last but one each does the same to what enters it,

    rows_j = W S_j + V x_j,    x_{j+1} = E S_j + Ψ x_j                 x: the filter's state for every column

and one pass through the second cycle, with a column for each state beside its own, gives W, V, E and Ψ. The first
cycle, and the last one with what follows it, are gone through as they are.
"""

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.whitening import FilterState, whiten_from

# By how much of what a state is known beforehand its variance may still change from a cycle to the next.
_SETTLED = 5e-3


def repeated_gram(
    steps: NoiseSteps, columns: Float[np.ndarray, "R p"], rows: int, shifts: Float[np.ndarray, "J p p"], degree: int
) -> Float[np.ndarray, "p p"] | None:
    """`Φᵀ V⁻¹ Φ` of J + 2 cycles of `rows` readings each, and of what follows them.

    `steps`, `columns`: of the first three cycles, and after them of what follows the last. `shifts`: S of the second
    cycle (one), of the third, and so on. `degree`: of S in the number of the cycle, and a few more for what enters.

    None where the noise has not settled after one cycle: drifts of several times its length. Otherwise standard
    deviations are those of all cycles to 1e-3, and to some 1e-5 with drifts that are forgotten in a cycle's time.
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
    # Cycles are many and their entries a polynomial of few terms: its coefficients for orthonormal ones carry the sum.
    basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, len(shifts)), degree + 1))[0]
    few = np.reshape(basis.T @ entries.reshape(len(entries), -1), (-1, p + count, p))
    end = np.concatenate([shifts[-1], entering])
    return first[:p, :p] + np.sum(few.swapaxes(1, 2) @ (every @ few), axis=0) + end.T @ last @ end
