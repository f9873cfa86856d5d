"""Files to core objects and back: the one room that knows both.

`assemble(spec)` builds the sensor model and the schedules; `predict` and `timeline` fill the contracts that other
programs read.
"""

from gradcal_jax.api.build import assemble
from gradcal_jax.api.prediction import monte_carlo, predict, recipe
from gradcal_jax.api.timeline import timeline
from gradcal_jax.api.verdicts import UNIT_OF, limit_of
