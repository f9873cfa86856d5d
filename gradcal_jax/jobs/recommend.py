"""One case of a catalogue: its plan optimised, written as a recipe, and set beside what no plan can beat."""

from collections.abc import Mapping
from typing import Any

from gradcal_jax.files import Spec, spec_of, to_toml
from gradcal_jax.files.contracts import RequirementRow

HEADER = "Made by gradcal recipes; `gradcal show` prints it as a table."


def recommend(tables: Mapping[str, Any]) -> dict[str, Any]:
    """The optimised recipe of a spec as TOML text, and its row of the summary. Errors: `ValueError` as `optimise`'s."""
    from gradcal_jax import assemble
    from gradcal_jax.assemble.optimise import Optimised, optimise

    spec = spec_of(tables)
    *_, best = optimise(spec)
    assert isinstance(best, Optimised)
    record: dict[str, Any] = {
        "objective": best.name,
        "unit": best.unit,
        "found": best.found,
        "now": best.now,
        "converged": best.converged,
        "sentence": best.sentence,
        "gradient_norm": best.gradient_norm,
        "structure": best.structure,
        "starts": [float(f"{v:.6g}") for v in best.starts],
        "active_limits": list(best.active),
        "shadow_prices": [{"limit": p.limit, "per": p.per, "change": p.change} for p in best.prices],
    }
    if best.before is not None:
        record["before"] = best.before
    seed = None if spec.design is None else spec.design.seed
    status, plan, now = best.sentence, best.spec, best.now
    if best.before is not None and best.before <= best.now:
        # Nothing better was found in the freedom given: then the plan as written is what to recommend.
        status = f"as written, for the search found nothing better ({best.now:.4g} {best.unit}; {best.sentence})"
        plan = spec
    made = assemble.recipe(plan, status=status, seed=seed, optimisation=record)
    decisive = next((row for row in made.prediction.requirements if row.name == best.name), None)
    if plan is spec:
        now = _decisive(decisive) or now
    limit = limit_of(spec)
    return {
        "toml": to_toml(made, header=HEADER),
        "objective": best.name,
        "unit": best.unit,
        "before": best.before,
        "now": now,
        "limit": limit,
        "efficiency": None if limit is None or now <= 0.0 else limit / now,
        "hours": made.duration_s / 3600.0,
        "verdict": (decisive.verdict if decisive is not None else None) or "",
        "limited_by": (decisive.limited_by if decisive is not None else None) or "",
        "converged": best.converged,
        "sentence": status,
    }


def _decisive(row: RequirementRow | None) -> float | None:
    """The statistic that a requirement asks for."""
    if row is None:
        return None
    return {"mean of max": row.mean_of_max, "max": row.max, "mean": row.mean, "rms": row.rms}[row.statistic]


def limit_of(spec: Spec) -> float | None:
    """What no plan on this rig in this time can beat, in the objective's unit; None where there is no such proof."""
    del spec
    return None
