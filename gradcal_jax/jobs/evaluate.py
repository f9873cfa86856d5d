"""Points of a sweep, predicted many at a time: what a worker does with its share.

The numbers are those of `gradcal_jax.assemble.predict`; what is not asked for (the parameters' covariance, warnings,
shares of the error sources) is not computed.
"""

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.assemble import assemble, knowledge
from gradcal_jax.assemble.build import error_model
from gradcal_jax.assemble.knowledge import UNIT_OF, box, verdict
from gradcal_jax.errormodel import GyroModel, Map
from gradcal_jax.files import Spec, changed, spec_of, to_toml
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.information import STATISTICS, Posterior, posterior, residual, statistic
from gradcal_jax.jobs.batch import in_own_shape, informations
from gradcal_jax.jobs.layout import Plan, plans_of
from gradcal_jax.jobs.results import Residual, Result, one_line
from gradcal_jax.jobs.room import OWN_SHAPE, Counts, Layout, Surveyed, sizes

Changes = Mapping[str, object]


# --- survey -----------------------------------------------------------------------------------------------------------


def survey(base: Mapping[str, Any], points: Iterable[Changes]) -> list[Surveyed]:
    """Read every point as a spec, and say which could share a compiled program."""
    spec = spec_of(base)
    known: dict[Any, Any] = {}
    once = lambda x: known.setdefault(x, x)  # noqa: E731
    found: list[Surveyed] = []
    for changes in points:
        try:
            here = changed(spec, changes)
            plans = plans_of(here)
        except (ValueError, OverflowError, ArithmeticError) as error:
            found.append(Surveyed("", (), (), one_line(error)))
            continue
        if plans is None:
            found.append(Surveyed(OWN_SHAPE, (), ()))
            continue
        kinds, counts = tuple(once(p.kind) for p in plans), tuple(once(p.counts) for p in plans)
        group = repr((kinds, [sizes(c) for c in counts], structure(here)))
        found.append(Surveyed(once(group), once(kinds), counts))
    return found


def structure(spec: Spec) -> str:
    """Text of everything in sensor and reference that a compiled program takes for fixed: structure, not numbers."""
    angle, sensor = spec.rig.table.angle, spec.sensor
    return _structure(sensor.model_dump_json(exclude_none=True) + angle.model_dump_json(exclude_none=True))


@lru_cache(maxsize=1024)
def _structure(text: str) -> str:
    parts = re.split(r'("(?:temperature|rate)":\{[^{}]*"basis"[^{}]*\})', text)
    # Bases are part of the structure, numbers with units elsewhere are not; but for nought, which takes a term away.
    return "".join(part if i % 2 else re.sub(r'"-?(?:0?\.?0*[1-9])[^"]*"', '"*"', part) for i, part in enumerate(parts))


# --- a chunk ----------------------------------------------------------------------------------------------------------


def predict_points(
    base: Mapping[str, Any], points: list[tuple[int, Changes]], rooms: tuple[Counts, ...]
) -> list[Result]:
    """Predict points of one group. `rooms`: the layout's of each channel; none for points in their own shape."""
    spec = spec_of(base)
    specs: dict[int, Spec] = {}
    results: dict[int, Result] = {}
    for index, changes in points:
        try:
            specs[index] = changed(spec, changes)
        except ValueError as error:
            results[index] = Result(index, one_line(error))
    known: dict[int, dict[str, tuple[Posterior, GyroModel]]] = {}
    try:
        known = _in_layout(specs, rooms) if rooms else _in_own_shape(specs)
    except Exception:
        # One bad point must not take its neighbours along: each is tried by itself, and says what is wrong with it.
        known = {}
    for index, here in specs.items():
        try:
            results[index] = _result(index, here, known.get(index) or _alone(here))
        except Exception as error:
            results[index] = Result(index, one_line(error))
    return [results[index] for index, _ in points]


def _in_layout(specs: dict[int, Spec], rooms: tuple[Counts, ...]):
    known: dict[int, dict[str, tuple[Posterior, GyroModel]]] = {index: {} for index in specs}
    groups: dict[Any, list[tuple[int, Plan, GyroModel]]] = {}
    for index, spec in specs.items():
        model, shape = model_of(spec)
        plans = plans_of(spec)
        assert plans is not None
        for plan, room in zip(plans, rooms, strict=True):
            groups.setdefault((Layout(plan.kind, room), shape), []).append((index, plan, model))
    for (layout, _), members in groups.items():
        found = informations(layout, [plan for _, plan, _ in members], [model for *_, model in members])
        for (index, _, model), info in zip(members, found, strict=True):
            known[index][layout.kind.channel] = (posterior(info), model)
    return known


def _in_own_shape(specs: dict[int, Spec]):
    known: dict[int, dict[str, tuple[Posterior, GyroModel]]] = {index: {} for index in specs}
    groups: dict[Any, list[tuple[int, Any]]] = {}
    for index, spec in specs.items():
        if isinstance(spec.plan, StandardPlan) and spec.plan.estimator == "least squares":
            known[index] = _alone(spec)
            continue
        built = assemble(spec)
        lag = None if built.thermal_lag is None else jnp.asarray(built.thermal_lag)
        tree = (built.plan, built.model, lag)
        shape = (jax.tree.structure(tree), tuple(np.shape(leaf) for leaf in jax.tree.leaves(tree)))
        for channel in built.channels:
            groups.setdefault((shape, channel), []).append((index, (built.plan, built.model, lag)))
    for (_, channel), members in groups.items():
        plans, models, lags = (list(column) for column in zip(*(tree for _, tree in members), strict=True))
        for (index, tree), info in zip(members, in_own_shape(plans, models, lags, channel), strict=True):
            known[index][channel] = (posterior(info), tree[1])
    return known


def _alone(spec: Spec) -> dict[str, tuple[Posterior, GyroModel]]:
    built = assemble(spec)
    return {channel: (knowledge(built, channel), built.model) for channel in built.channels}


def model_of(spec: Spec) -> tuple[GyroModel, Any]:
    """The error model with NumPy numbers, and its structure; made once for each sensor and reference."""
    table = spec.rig.table
    key = spec.sensor.model_dump_json() + table.angle.model_dump_json() + str(table.rate_accuracy)
    if key not in _MODELS:
        if len(_MODELS) > 4096:
            _MODELS.clear()
        model = jax.tree.map(np.asarray, error_model(spec))
        shape = (jax.tree.structure(model), tuple(np.shape(leaf) for leaf in jax.tree.leaves(model)))
        _MODELS[key] = (model, shape)
    return _MODELS[key]


_MODELS: dict[str, tuple[GyroModel, Any]] = {}


def _result(index: int, spec: Spec, known: dict[str, tuple[Posterior, GyroModel]]) -> Result:
    rows: list[Residual] = []
    for i, requirement in enumerate(spec.requirement):
        for channel, (what, model) in known.items():
            values = residual_values(what, model, requirement)
            rows.append(_row(i, channel, requirement, values))
    schedule = spec.schedule
    return Result(index, "", schedule.duration, schedule.soak, schedule.motion, tuple(rows))


def _row(i: int, channel: str, requirement: Requirement, values: np.ndarray) -> Residual:
    factor = UNIT_OF[requirement.quantity][1]
    found: list[float | None] = []
    for name in STATISTICS:
        value = statistic(name, values) * factor
        none = not np.isfinite(value) or (requirement.quantity == "bias" and name == "mean of max")
        found.append(None if none else value)
    said = verdict(requirement, found[STATISTICS.index(requirement.statistic)])
    return Residual(i, channel, tuple(found), said or "")


# --- the residual map -------------------------------------------------------------------------------------------------


def residual_values(known: Posterior, model: GyroModel, requirement: Requirement) -> np.ndarray:
    """The residual on a requirement's box `(n_T, n_ω)`, in SI: `information.residual`, by products of small tables.

    A map is a tensor product ψ(T)⊗χ(ω), so for each temperature `s²(ω) = χᵀ(A Aᵀ)χ` with A = ψ(T)·spread: twenty times
    fewer operations than the square of every row. Maps with a discrepancy, and plans that leave something unobservable,
    take the plain road.
    """
    temperatures, rates = box(requirement)
    of = model.bias if requirement.quantity == "bias" else model.scale
    if of is None or of.discrepancy_size or known.hidden.shape[1]:
        return residual(known, model, requirement.quantity, temperatures, rates)
    where = model.columns.bias if requirement.quantity == "bias" else model.columns.scale
    spread = known.spread[where]
    if of.rate is None:
        by_temperature = _values(of, "temperature", temperatures) @ spread
        return np.sqrt(np.sum(by_temperature**2, axis=1))[:, None]
    by_t, by_w = _values(of, "temperature", temperatures), _values(of, "rate", rates)
    size = by_w.shape[1]
    half = np.tensordot(by_t, spread.reshape(by_t.shape[1], size, -1), axes=1)
    square = half @ np.swapaxes(half, 1, 2)
    pairs = (by_w[:, :, None] * by_w[:, None, :]).reshape(len(rates), -1)
    return np.sqrt(np.maximum(square.reshape(len(temperatures), -1) @ pairs.T, 0.0))


def _values(of: Map, which: str, points: np.ndarray) -> np.ndarray:
    """A basis on a grid; the same for a whole sweep, mostly."""
    basis = of.temperature if which == "temperature" else of.rate
    # The basis itself is kept beside its values, so that no other can take its place in memory.
    key = (id(basis), points[0], points[-1], len(points))
    if key not in _BASES:
        if len(_BASES) > 256:
            _BASES.clear()
        assert basis is not None
        _BASES[key] = (basis, np.asarray(basis(jnp.asarray(points))))
    return _BASES[key][1]


_BASES: dict[Any, tuple[Any, np.ndarray]] = {}


# --- optimised points -------------------------------------------------------------------------------------------------


def optimise_points(
    base: Mapping[str, Any], points: list[tuple[int, Changes]], rooms: tuple[Counts, ...]
) -> list[Result]:
    """Optimise the plan of each point and predict what it leaves; `rooms` are not needed here."""
    del rooms
    spec = spec_of(base)
    results: list[Result] = []
    for index, changes in points:
        try:
            results.append(_optimised(index, changed(spec, changes)))
        except Exception as error:
            results.append(Result(index, one_line(error)))
    return results


def _optimised(index: int, spec: Spec) -> Result:
    from gradcal_jax.assemble.flow import optimise

    found = optimise(spec)
    done = _result(index, found.spec, _alone(found.spec))
    return done._replace(before=found.before, note=found.sentence, spec=to_toml(found.spec))


def recommend(tables: Mapping[str, Any]) -> dict[str, Any]:
    """One case of a catalogue: see `gradcal_jax.jobs.recommend`."""
    from gradcal_jax.jobs import recommend as cases

    return cases.recommend(tables)


TASKS: Final = {"survey": survey, "predict": predict_points, "optimise": optimise_points, "recommend": recommend}
"""What a worker can be asked to do."""
