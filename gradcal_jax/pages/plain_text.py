"""Values and tables as plain text: on a terminal, on paper, in a notebook."""

from gradcal_jax.display import WIDTH as WIDTH
from gradcal_jax.display import amount as amount
from gradcal_jax.display import columns as columns
from gradcal_jax.units import times_text as times_text
