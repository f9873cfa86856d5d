"""What a search yields: its progress, and at the end the optimised plan with the record of the search."""

import math
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.api.contract_rows import finite
from gradcal_jax.display import summary
from gradcal_jax.files.spec_sections import Spec

MARGIN: Final = 0.1
"""A target is met with margin where the residual is less than the target by this share."""
MET: Final = f"every target is met with a margin of {MARGIN:.0%}"
NO_TARGET: Final = "to stop when every target is met, give a requirement a target"


class SearchStep(NamedTuple):
    """Progress of an optimisation: `best` in `unit`, of `name`; `share` of the work that is done, 0 to 1.

    `missed`: the limits that the best plan so far exceeds, in words. `checkpoint`: arrays from which `optimise` resumes
    the search.
    """

    name: str
    unit: str
    before: float | None
    best: float
    share: float
    words: str
    missed: str
    checkpoint: dict[str, np.ndarray]


class Price(NamedTuple):
    """The shadow price of a limit: the change of the objective for each `per` by which the limit is eased, zero or
    less; up to `linear` of them (None: unknown) the change is in proportion."""

    limit: str
    per: str
    change: float
    linear: float | None = None


class PricedLimit(NamedTuple):
    """A limit that may be eased: the unit `per` which it is priced, that unit and the limit's size in SI; a size that
    is zero or not finite: there is no such limit."""

    name: str
    per: str
    unit: float
    size: float


# Step of a derivative, as a share of the limit; easings at which a price is compared with the objective itself, and the
# relative error up to which it is linear.
_STEP: Final = 1e-4
_LINEAR_STEPS: Final = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01)
_LINEAR: Final = 0.2


def priced(value: float, limits: Sequence[PricedLimit], log: Callable[[np.ndarray], float]) -> tuple[Price, ...]:
    """The prices of limits at an optimum of a `value`, from the objective's logarithm with the limits eased by so much
    (SI), by central differences.

    A plan within a limit is within an eased one, so that no price is positive: where a slope is, the point is not
    quite an optimum, or the limit does not bind.
    """
    prices, eye = [], np.eye(len(limits))
    start = log(0.0 * eye[0])
    for by, (name, per, unit, size) in zip(eye, limits, strict=True):
        if not 0.0 < size < math.inf:
            continue
        step = _STEP * size
        slope = (log(step * by) - log(-step * by)) / (2.0 * step)
        price = float(min(value * slope, 0.0) * unit)
        steps = _LINEAR_STEPS if price else ()
        bent = (abs((log(s * unit * by) - start) / (slope * s * unit) - 1.0) for s in steps)
        prices.append(Price(name, per, price, next((s for s, b in zip(steps, bent, strict=True) if b < _LINEAR), None)))
    return tuple(prices)


class RequirementChange(NamedTuple):
    """A requirement's statistic (`unit`, 1σ, by the terms that the spec names) before and after a search; None: not
    observable."""

    name: str
    unit: str
    before: float | None
    now: float | None


class Optimised(NamedTuple):
    """An optimised spec (rounded), and the record of its search. Values in `unit`.

    `before`: of the plan in the spec, None where it observes too little; `optimum`: before rounding; `now`: of the
    rounded plan, exactly. `rows`: every requirement. `kept`: nothing better was found than the spec's own plan, which
    it is. `starts`: where the starts of the chosen structure ended, `inf` where one exceeds a limit. `active`: the
    limits that bind, in words. `evaluations`: of the objective and its gradient, where they are counted.
    """

    spec: Spec
    name: str
    unit: str
    before: float | None
    optimum: float
    now: float
    converged: bool
    sentence: str
    rows: tuple[RequirementChange, ...]
    structure: str
    kept: bool = False
    starts: tuple[float, ...] = ()
    gradient_norm: float | None = None
    active: tuple[str, ...] = ()
    prices: tuple[Price, ...] = ()
    evaluations: int | None = None

    __repr__ = summary

    @property
    def gain(self) -> float:
        """Geometric mean of before over now, of all requirements; 1 where none is observable."""
        ratios = [math.log(row.before / row.now) for row in self.rows if row.before and row.now]
        return math.exp(fmean(ratios)) if ratios else 1.0


def record_of(best: Optimised) -> dict[str, Any]:
    """An optimisation as a table of a recipe and of --json."""
    record: dict[str, Any] = {
        "before": best.before,
        "objective": best.name,
        "unit": best.unit,
        "found": best.optimum,
        "now": finite(best.now),
        "converged": best.converged,
        "kept": best.kept,
        "gain": best.gain,
        "sentence": best.sentence,
        "gradient_norm": best.gradient_norm,
        "structure": best.structure,
        "evaluations": best.evaluations,
        "starts": [float(f"{v:.6g}") for v in best.starts if np.isfinite(v)] or None,
        "active_limits": list(best.active),
        "shadow_prices": [
            {"limit": p.limit, "per": p.per, "change": p.change}
            | ({} if p.linear is None else {"linear_up_to": p.linear})
            for p in best.prices
        ],
        "requirements": [{k: v for k, v in row._asdict().items() if v is not None} for row in best.rows],
    }
    return {name: value for name, value in record.items() if value is not None}
