"""The recipe of a plan, with the prediction of what is executed."""

from collections.abc import Mapping
from typing import Any

import gradcal_jax
from gradcal_jax.design.searching import Optimised, record_of
from gradcal_jax.information.prediction import predict
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.recipe.recipe import FORMAT, Predicted, Recipe, RecipeOrigin
from gradcal_jax.recipe.rounding import ControllerSteps, rounded, steps_of
from gradcal_jax.recipe.tracks import Stability, tracks_of
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec

_VERSIONS = ("jax", "numpy", "equinox")
NOT_OPTIMISED = "not optimised: the plan of the spec"


def make_recipe(
    plan: Spec | Optimised,
    *,
    resolution: ControllerSteps | None = None,
    stability: Stability | None = None,
    status: str = "",
    seed: int | None = None,
    optimisation: Mapping[str, Any] | None = None,
    notes: tuple[str, ...] = (),
) -> Recipe:
    """The plan of a spec, or an optimised one, made executable, with the prediction (ppm, deg/h) of what is executed.

    `resolution`: the controllers' steps; None: those of `[rig.resolution]`, and defaults. `stability`: when a
    temperature counts as stable, and how long to wait for it. Turns become trapezoids of the same angle, peak rate and
    duration. `status`, `seed`, `optimisation` (of TOML's types) and `notes` are copied; an optimised plan has its own.

    Errors: `SpecError` where the rounded plan leaves a limit of the rig.
    """
    spec = expect_spec(getattr(plan, "spec", plan))
    if not isinstance(plan, Spec):
        status, optimisation = status or plan.sentence, optimisation or record_of(plan)
        seed = plan.spec.design.seed if seed is None and plan.spec.design is not None else seed
    steps = resolution or steps_of(spec)
    executable = rounded(spec, steps)
    chamber, motion = tracks_of(executable.spec, None if steps.acceleration is None else float(steps.acceleration))
    rows = Predicted.of(predict(executable.spec, limits=True))
    fields: dict[str, Any] = {
        "format": FORMAT,
        "title": spec.title,
        "status": status or NOT_OPTIMISED,
        "notes": (*notes, *executable.notes) or None,
        "rounded": executable.changes or None,
        "made": RecipeOrigin(
            by=f"gradcal {gradcal_jax.__version__}", versions=versions_of(_VERSIONS), **_without_none(seed=seed)
        ),
        "resolution": ControllerSteps(**_without_none(**{n: getattr(steps, n) for n in ControllerSteps.model_fields})),
        # With defaults, which may change in another version.
        "stability": Stability(**{n: getattr(stability or Stability(), n) for n in Stability.model_fields}),
        "chamber": chamber,
        "motion": motion,
        "prediction": rows,
        "optimisation": None if optimisation is None else dict(optimisation),
        "spec": executable.spec,
    }
    return Recipe(**_without_none(**fields))


def _without_none(**values: Any) -> dict[str, Any]:
    """The values that are not None: a file has no key for None."""
    return {name: value for name, value in values.items() if value is not None}
