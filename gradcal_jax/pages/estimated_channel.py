"""The estimate of a gyro axis as tables: its coefficients, and the tests of its fit."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.api.contract_rows import counted_std
from gradcal_jax.api.unit_channel import UnitChannel
from gradcal_jax.files.calibration import UnseenError

_SHOWN: Final = {
    "1": ("ppm", units.PPM),
    "rad/s": ("deg/h", units.DEG_PER_H),
    "rad/K": ("deg/h/(K/min)", units.DEG_PER_H / 60.0),
    "rad": ("arcsec", units.ARCSEC),
}


def estimated_coefficients(
    channel: UnitChannel, unseen: Sequence[UnseenError]
) -> tuple[list[tuple[str, ...]], tuple[int, ...]]:
    """The coefficients after a head, and the numbers of the columns that are flush right. `unseen`: errors that no
    residual shows, which the standard deviation counts beside that of the fit."""
    model = channel.model
    reported = model.to_reported
    known = channel.estimate.known[0]
    values, deviations = reported @ channel.estimate.parameters[0], known.deviations(reported)
    rows: list[tuple[str, ...]] = [("parameter", "value", "1σ", "of the fit", "unit")]
    for k, (name, si) in enumerate(zip(model.names(), model.units(), strict=True)):
        unit, factor = _SHOWN[si]
        if np.isfinite(deviations[k]):
            of_fit = float(deviations[k])
            counted, fit = (
                f"{(s or 0.0) * factor:.4g}"
                for s in (counted_std(f"gyro_{channel.axis}.{name}", of_fit, unseen), of_fit)
            )
            rows.append((name, f"{values[k] * factor:.4f}", counted, fit, unit))
        else:
            rows.append((name, "not observable", "", "", unit))
    return (rows, (1, 2, 3)) if unseen else ([(*row[:3], row[4]) for row in rows], (1, 2))


def tests_of_channel(channel: UnitChannel) -> list[tuple[str, ...]]:
    """The tests of its fit after a head."""
    tests = channel.consistency
    rows: list[tuple[str, ...]] = [("test", "statistic", "degrees", "chance")]
    for name, test in [
        ("χ² of the fit", tests.fit),
        ("whiteness of the residuals", tests.whiteness),
        *((f"structure beyond the model, {t.quantity.replace('_', ' ')}", t.test) for t in channel.structure),
        *((split.name, split.agreement) for split in tests.splits),
    ]:
        rows.append((name, f"{test.statistic:.1f}", str(test.degrees), f"{test.probability:.2g}"))
    return rows
