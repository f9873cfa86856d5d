"""The standard deviations of a prediction's coefficients as a table."""

from typing import Final

from gradcal_jax import units
from gradcal_jax.files.contracts import Prediction

_SHOWN: Final = {
    "rad/s": ("deg/h", units.DEG_PER_H),
    "1": ("ppm", units.PPM),
    "rad/K": ("deg/h/(K/min)", units.DEG_PER_H / 60.0),
}


def coefficient_table(prediction: Prediction) -> tuple[list[tuple[str, ...]], tuple[int, ...]]:
    """The table after a head, and the numbers of its columns that are flush right."""
    if any(row.axis == "unit" for row in prediction.parameters):
        from gradcal_jax.pages.unit import parameter_table

        return parameter_table(prediction), (1, 2, 3)
    rows: list[tuple[str, ...]] = [("parameter", "1σ", "unit")]
    several = len({row.axis for row in prediction.parameters}) > 1
    for row in prediction.parameters:
        unit, factor = _SHOWN.get(row.unit, (row.unit, 1.0))
        name = f"{row.name}, axis {row.axis}" if several else row.name
        rows.append((name, "not observable" if row.std is None else f"{row.std * factor:.4g}", unit))
    return rows, (1,)
