"""`tables.text_template`, for `spec`, which still takes it from here."""

from gradcal_jax.tables.text_template import rendered as rendered
