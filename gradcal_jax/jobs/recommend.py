"""One case of a catalogue: its plan optimised, written as a recipe, and set beside what no plan can beat."""

from collections.abc import Mapping
from typing import Any

from gradcal_jax.files import Spec, spec_of, to_toml

HEADER = "Made by gradcal recipes; `gradcal show` prints it as a table."


def recommend(tables: Mapping[str, Any]) -> dict[str, Any]:
    """The optimised recipe of a spec as TOML text, and its row of the summary. Errors: `ValueError` as `optimise`'s."""
    from gradcal_jax import api
    from gradcal_jax.api.flow import optimise

    spec = spec_of(tables)
    best = optimise(spec)
    made = api.recipe(best)
    wanted = None if spec.design is None else spec.design.minimise
    decisive = next((row for row in made.prediction.requirements if row.name == wanted), None)
    limit = limit_of(spec)
    return {
        "toml": to_toml(made, header=HEADER),
        "objective": best.name,
        "unit": best.unit,
        "before": best.before,
        "now": best.now,
        "limit": limit,
        "efficiency": None if limit is None or best.now <= 0.0 else limit / best.now,
        "hours": made.duration_s / 3600.0,
        "verdict": (decisive.verdict if decisive is not None else None) or "",
        "limited_by": (decisive.limited_by if decisive is not None else None) or "",
        "converged": best.converged,
        "sentence": best.sentence,
    }


def limit_of(spec: Spec) -> float | None:
    """What no plan on this rig in this time can beat, in the objective's unit; None where there is no such proof."""
    from gradcal_jax.api.limit import limits

    try:
        return next((row.certified for row in limits(spec) if spec.design and row.name == spec.design.minimise), None)
    except ValueError:
        return None
