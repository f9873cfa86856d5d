"""What a plan cannot observe, said in the names of the parameters."""

import numpy as np

from gradcal_jax.errormodel import GyroModel
from gradcal_jax.errormodel.bases import Polynomial
from gradcal_jax.information.posterior import Posterior


def parameter_names(model: GyroModel) -> list[str]:
    """Names of the reported parameters in the model's order, nuisances last.

    As in the paper for polynomials: `a{k}` multiplies the k-th power of temperature in B; `b{j}{i}` the j-th power of
    rate and the i-th of temperature in M. Other bases count their functions: `a_bin3`, `b_spline2_1`.
    """
    names: list[str] = []
    if model.bias is not None:
        t = model.bias.temperature
        names += [f"a{_ordinal(t, i)}" for i in range(t.size)]
    if model.scale is not None and model.scale.rate is not None:
        t, w = model.scale.temperature, model.scale.rate
        short = isinstance(t, Polynomial) and isinstance(w, Polynomial) and max(t.size, w.size) <= 10
        for i in range(t.size):
            names += [f"b{j}{i}" if short else f"b{_ordinal(w, j)}_{_ordinal(t, i)}" for j in range(w.size)]
    if model.has_gradient:
        names.append("bias_temperature_gradient")
    for order in model.reference.harmonic_orders:
        names += [f"angle_cos{order}", f"angle_sin{order}"]
    for prefix, of in (("bias", model.bias), ("scale_factor", model.scale)):
        if of is not None:
            names += [f"{prefix}_discrepancy{k}" for k in range(of.discrepancy_size)]
    return names


def _ordinal(basis, index: int) -> str:
    if isinstance(basis, Polynomial):
        return str(index)
    return f"_{type(basis).__name__.lower().removeprefix('b').replace('ins', 'bin')}{index}"


def to_reported(model: GyroModel) -> np.ndarray:
    """`(p, p)`: the engine's parameters to the reported ones; identity but for the two maps."""
    matrix = np.eye(model.columns.count)
    for of, where in ((model.bias, model.columns.bias), (model.scale, model.columns.scale)):
        if of is not None:
            matrix[where, where] = of.to_reported
    return matrix


def unobservable_combinations(known: Posterior, model: GyroModel) -> list[str]:
    """Each combination of reported parameters of which the plan says nothing, written out: "a0 - 0.5·a2"."""
    if not known.hidden.shape[1]:
        return []
    directions = _echelon((to_reported(model) @ known.hidden).T)
    names = parameter_names(model)
    return [_written(row, names) for row in directions]


def _echelon(rows: np.ndarray) -> np.ndarray:
    """Reduced row-echelon form, pivoting on the largest entry: each combination becomes as short as it can be."""
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


def _written(row: np.ndarray, names: list[str]) -> str:
    row = row / np.max(np.abs(row))
    terms = [(value, name) for value, name in zip(row, names, strict=True) if abs(value) > 1e-6]
    if len(terms) == 1:
        return terms[0][1]
    text = " ".join(
        f"{'-' if value < 0 else '+'} " + (name if abs(abs(value) - 1) < 1e-6 else f"{abs(value):.3g}·{name}")
        for value, name in terms
    )
    return text.removeprefix("+ ")
