"""Unobservable combinations of the parameters, by their names."""

import numpy as np

from gradcal_jax.information.posterior import Posterior
from gradcal_jax.model import ImuModel, SensorModel


def unobservable_combinations(known: Posterior, model: SensorModel | ImuModel) -> list[str]:
    """Each unobservable combination of reported parameters as text: "a0 - 0.5·a2"."""
    if not known.hidden.shape[1]:
        return []
    return [_as_text(row, model.names()) for row in _echelon((model.to_reported @ known.hidden).T)]


def _echelon(rows: np.ndarray) -> np.ndarray:
    """Reduced row-echelon form with pivots on the largest entry, for the shortest combinations."""
    rows = rows / np.max(np.abs(rows), axis=1, keepdims=True)
    done: list[int] = []
    for k in range(len(rows)):
        free = np.array([j for j in range(rows.shape[1]) if j not in done])
        i, j = np.unravel_index(np.argmax(np.abs(rows[k:][:, free])), (len(rows) - k, len(free)))
        rows[[k, k + i]] = rows[[k + i, k]]
        pivot = int(free[j])
        rows[k] = rows[k] / rows[k, pivot]
        for other in range(len(rows)):
            if other != k:
                rows[other] = rows[other] - rows[other, pivot] * rows[k]
        done.append(pivot)
    return rows[np.argsort(done)]


def _as_text(row: np.ndarray, names: list[str]) -> str:
    row = row / np.max(np.abs(row))
    terms = [(value, name) for value, name in zip(row, names, strict=True) if abs(value) > 1e-6]
    if len(terms) == 1:
        return terms[0][1]
    text = " ".join(
        f"{'-' if value < 0 else '+'} " + (name if abs(abs(value) - 1) < 1e-6 else f"{abs(value):.3g}·{name}")
        for value, name in terms
    )
    return text.removeprefix("+ ")
