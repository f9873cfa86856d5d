"""The recipe of a plan, with the prediction of what is executed."""

from typing import Any

import gradcal_jax
from gradcal_jax.design.optimise import Optimised, record_of
from gradcal_jax.information.prediction import predict
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.recipe.recipe import FORMAT, Predicted, Recipe, RecipeOrigin
from gradcal_jax.recipe.rounding import ControllerSteps, rounded, steps_of
from gradcal_jax.recipe.tracks import Stability, tracks_of
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec

_VERSIONS = ("jax", "numpy", "equinox")
NOT_OPTIMISED = "not optimised: the plan of the spec"


def make_recipe(plan: Spec | Optimised, *, status: str = "") -> Recipe:
    """The plan of a spec, or an optimised one, made executable, with the prediction (ppm, deg/h) of what is executed.

    Turns become trapezoids of the same angle, peak rate and duration, in the controllers' steps of `[rig.resolution]`
    and its defaults. `status`: how the plan was made; an optimised plan says so itself.

    Errors: `SpecError` where the rounded plan leaves a limit of the rig.
    """
    spec = expect_spec(getattr(plan, "spec", plan))
    steps, executable = steps_of(spec), rounded(spec)
    chamber, motion = tracks_of(executable.spec, None if steps.acceleration is None else float(steps.acceleration))
    made: dict[str, Any] = {"by": f"gradcal {gradcal_jax.__version__}", "versions": versions_of(_VERSIONS)}
    # A file has no key for None, and defaults may change in another version.
    given = {name: value for name in ControllerSteps.model_fields if (value := getattr(steps, name)) is not None}
    fields: dict[str, Any] = {"title": spec.title, "notes": executable.notes, "rounded": executable.changes}
    if not isinstance(plan, Spec):
        status, fields["optimisation"] = status or plan.sentence, record_of(plan)
        made |= {} if spec.design is None else {"seed": spec.design.seed}
    return Recipe(
        format=FORMAT,
        status=status or NOT_OPTIMISED,
        made=RecipeOrigin.model_validate(made),
        resolution=ControllerSteps(**given),
        stability=Stability(**{name: getattr(Stability(), name) for name in Stability.model_fields}),
        chamber=chamber,
        motion=motion,
        prediction=Predicted.of(predict(executable.spec, limits=True)),
        spec=executable.spec,
        **{name: value for name, value in fields.items() if value},
    )
