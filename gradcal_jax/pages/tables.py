"""Tables of results, which terminal, page and certificate share."""

import re
from typing import Final

from gradcal_jax.calibration.file import Calibration
from gradcal_jax.information.residual import UNITS_OF_TERMS
from gradcal_jax.spec.contracts import Prediction
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Cell, Column, Table, cell_text
from gradcal_jax.units import DEG_PER_H, DEG_PER_S

_ONE_SIGMA = Column("1σ", "", 3)
_ROUNDING = 1e-9
# Of coefficients; "s" is the unit of a bias by a product of two rates.
_UNITS: Final = UNITS_OF_TERMS | {
    "rad/K": ("deg/h/(K/min)", DEG_PER_H / 60.0),
    "s": ("deg/h/(deg/s)^2", DEG_PER_H / DEG_PER_S**2),
}
COVERAGE: Final = 2.0
"""Of an expanded uncertainty whose requirement states none."""


def coefficients(planned: Prediction | None, calibration: Calibration | None) -> Table:
    """Every coefficient with one standard deviation: of a calibration by its data, with errors that no residual shows,
    and as predicted by its plan."""
    predicted = {} if planned is None else {row.name: row for row in planned.parameters}
    if calibration is None:
        rows = []
        for name, row in predicted.items():
            unit, factor = _UNITS.get(row.unit, (row.unit, 1.0))
            std = "not observable" if row.std is None else cell_text(row.std * factor, 3)
            rows.append((_with_words(name), std, unit))
        return Table.of(["coefficient", "1σ", "unit"], rows)
    # Imported where it is used: a prediction needs no estimates.
    from gradcal_jax.estimation.calibration_rows import coefficient_rows

    cells = []
    for of in coefficient_rows(calibration):
        unit, factor = _UNITS.get(of["unit"], (of["unit"], 1.0))
        std = of["std_counted"]
        std_before = predicted[of["name"]].std if of["name"] in predicted else None
        before = std_before * factor if std_before is not None else None
        cells.append((of["name"], of["value"] * factor, None if std is None else std * factor, before, unit))
    if not predicted:
        cells = [(*row[:3], row[4]) for row in cells]
        return Table.of(["coefficient", Column("value", "", 6), _ONE_SIGMA, "unit"], cells)
    heads = ["coefficient", Column("value", "", 6), _ONE_SIGMA, Column("1σ predicted", "", 3), "unit"]
    return Table.of(heads, cells)


def _with_words(name: str) -> str:
    """The name of a coefficient; that of a bias by a product of two rates says so."""
    return re.sub(r"\.ww_(\w)(\w)$", r"\g<0> (rate \1 times rate \2)", name)


def results(calibration: Calibration) -> Table:
    """The results in a calibration file, with their expanded uncertainties."""
    rows: list[tuple[Cell, ...]] = []
    for row in calibration.result:
        k = row.coverage or COVERAGE
        # Nothing is certified of a unit whose data contradict the model.
        value = None if row.verdict == "not valid" else row.value
        expanded = None if value is None else k * value
        limit = "" if row.target is None else amount(row.target, row.unit)
        rows.append((row.name, row.axis, row.statistic, value, k, expanded, row.unit, limit, row.verdict or ""))
    return Table.of(["quantity", "axis", "statistic", "u", "k", "U", "unit", "limit", "decision"], rows)


def tests(calibration: Calibration) -> Table:
    """The tests of the fit."""
    rows = [
        (
            test.name.replace("_", " "),
            test.statistic,
            test.degrees,
            f"{test.chance:.2g}" if test.degrees else "too few readings",
        )
        for test in calibration.fit
    ]
    return Table.of(["test of the fit", "statistic", "degrees", "p-value"], rows)


def errors_of_table(calibration: Calibration) -> Table:
    """The errors of the table that were estimated from the same log."""
    rows = []
    for error in calibration.table:
        unit, factor = UNITS_OF_TERMS.get(error.unit, (error.unit, 1.0))
        # The rounding of an error that the data do not show is no value.
        value = error.value if abs(error.value) > _ROUNDING * error.standard_deviation else 0.0
        sizes = (value * factor, error.standard_deviation * factor, error.prior * factor)
        rows.append((error.name.replace("_", " "), *sizes, unit))
    return Table.of(["error of the table", "value", _ONE_SIGMA, Column("1σ before", "", 3), "unit"], rows)


def of_path(calibration: Calibration) -> Table:
    """What depends on the path of the temperature, in addition to the maps."""
    rows = []
    for one in calibration.path:
        unit, factor = _UNITS.get(one.unit, (one.unit, 1.0))
        rows.append((one.label, one.value * factor, one.standard_deviation * factor, unit))
    return Table.of(["in addition to the maps", "value", _ONE_SIGMA, "unit"], rows)
