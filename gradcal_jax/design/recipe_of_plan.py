"""The recipe of a plan, with the prediction of what is executed."""

from typing import Any

import gradcal_jax
from gradcal_jax.design.optimise import Optimised, record_of
from gradcal_jax.information.prediction import predict
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.recipe.recipe import FORMAT, Recipe, RecipeOrigin, fingerprint_of
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.recipe.tracks import Stability
from gradcal_jax.spec.contracts import Prediction
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
    executable = rounded(expect_spec(getattr(plan, "spec", plan)))
    spec, fields = executable.spec, dict[str, Any]()
    made: dict[str, Any] = {"by": f"gradcal {gradcal_jax.__version__}", "versions": versions_of(_VERSIONS)}
    if not isinstance(plan, Spec):
        status, fields["optimisation"] = status or plan.sentence, record_of(plan)
        made |= {} if spec.design is None else {"seed": spec.design.seed}
    fields |= {"title": spec.title} if spec.title else {}
    # A file has no key for None.
    left_out = {"format", "title", "covariance", "omitted"}
    prediction = predict(spec, limits=True).model_dump(exclude_none=True, exclude=left_out)
    return Recipe(
        format=FORMAT,
        status=status or NOT_OPTIMISED,
        notes=executable.notes,
        made=RecipeOrigin.model_validate(made),
        # Defaults may change in another version.
        stability=Stability(**{name: getattr(Stability(), name) for name in Stability.model_fields}),
        prediction=Prediction.model_validate(prediction),
        spec_fingerprint=fingerprint_of(spec),
        spec=spec,
        **fields,
    )
