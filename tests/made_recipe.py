"""A recipe of a spec, without a prediction."""

from gradcal_jax.recipe.recipe import Recipe, RecipeOrigin, fingerprint_of
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.recipe.tracks import Stability
from gradcal_jax.spec.contracts import Prediction


def made_of(spec, stability=None, **keys):
    """A recipe without a prediction: what the file room can make by itself."""
    executed = rounded(spec).spec
    return Recipe(
        format="gradcal-recipe/1",
        status="not optimised",
        made=RecipeOrigin(by="a test", versions={}),
        stability=stability or Stability(),
        prediction=Prediction(duration_s=1.0, soak_s=0.0, motion_s=1.0),
        spec_fingerprint=fingerprint_of(executed),
        spec=executed,
        **keys,
    )
