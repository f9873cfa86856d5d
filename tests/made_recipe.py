"""A recipe of a spec, without a prediction."""

from gradcal_jax.recipe.recipe import Predicted, Recipe, RecipeOrigin
from gradcal_jax.recipe.rounding import rounded, steps_of
from gradcal_jax.recipe.tracks import Stability, tracks_of


def made_of(spec, stability=None, **keys):
    """A recipe without a prediction: what the file room can make by itself."""
    result = rounded(spec)
    chamber, motion = tracks_of(result.spec, float(steps_of(spec).acceleration))
    return Recipe(
        format="gradcal-recipe/1",
        status="not optimised",
        made=RecipeOrigin(by="a test", versions={}),
        resolution=steps_of(spec),
        stability=stability or Stability(),
        chamber=chamber,
        motion=motion,
        prediction=Predicted(duration_s=1.0, soak_s=0.0, motion_s=1.0),
        spec=result.spec,
        **keys,
    )
