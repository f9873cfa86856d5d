"""The residual map's two ways are one: by products of small tables, and by a row for every point of the grid."""

import numpy as np
import pytest

from gradcal_jax.information import contrasts, information, posterior, residual
from gradcal_jax.model.build import assemble
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import parse_spec


@pytest.mark.parametrize("name", ["paper-dynamic-gradient", "paper-static-gradient"])
def test_the_residual_by_small_tables_is_the_residual_by_rows(name):
    built = assemble(parse_spec(presets.text(name)))
    known = posterior(information(built.trajectory(), built.model))
    assert known.hidden.shape[1] == 0
    for requirement in built.spec.requirement:
        low, high = (float(t) for t in requirement.temperature)
        temperatures = np.linspace(low, high, 11)
        rates = np.linspace(-1.0, 1.0, 9) * np.radians(100.0)
        quantity = requirement.quantity.removeprefix("gyro_")
        result = residual(known, built.model, quantity, temperatures, rates)
        points = (values.ravel() for values in np.meshgrid(temperatures, rates, indexing="ij"))
        rows, alone, beyond = contrasts(built.model, quantity, *points)
        assert not alone.any()
        assert not beyond.any()
        np.testing.assert_allclose(result, known.deviations(rows).reshape(result.shape), rtol=1e-10)
