"""Numbers that stay as they are: what the code at hand computes, against what is recorded beside this file.

`record.py` wrote them. A few cases are part of every run; `-m evidence` takes them all.
"""

import numpy as np
import pytest
import recorded

KEPT = {
    kind: recorded.read(kind)
    for kind in (
        "predictions",
        "judged",
        "elasticities",
        "units",
        "calibrations",
        "estimates",
        "axis_estimates",
    )
}
# Apart by 2e-12: two programs shifted the edges of bins in rate by a hundred rounding errors; and unweighted least
# squares with a nearly singular fit move by as much where a noise figure changes in its last digit.
ROUNDED = {"tactical 1", "any 5"}

# One of each method, basis and reference, quick ones; and two whose bias hardly anything is known of: where sums let
# rounding grow, the first of them fails.
PREDICTED = {"static gradient 0", "static standard 1", "dynamic standard 1", "tactical 3", "hand 1"}
PREDICTED |= {"tactical 10", "consumer 6"}
JUDGED = {"static gradient 2", "tactical 2", "dynamic standard 1", "dynamic standard 5", "preset tactical-mems"}
JUDGED |= {"static gradient 3", "tactical 10", "any 5", "hand 1"}
DERIVED = {"static gradient 0", "dynamic gradient 8"}
UNITS = {"one-axis-table", "accelerometer-six-positions", "gimbal-by-hand"}
ESTIMATED = {"axis readings", "axis standard", "unit two axes"}
AXES = {"axis readings", "axis standard"}
# What an axis's own estimator called its tests; that of halves divided the readings, not the rows.
TESTS_OF_AXES = {
    "gyro_x: χ² of the fit": "chi-squared of the fit",
}


def _cases(kind: str, always: set[str]) -> list:
    assert always <= set(KEPT[kind])
    found, predictions = [], KEPT["predictions"]
    for name, of in KEPT[kind].items():
        marks = [] if name in always else [pytest.mark.evidence]
        if kind == "elasticities":
            of = {"tables": predictions[name]["tables"], "rows": of}
        if kind == "judged":
            of = {"tables": predictions[name]["tables"], **of}
        found.append(pytest.param(of, id=name, marks=marks))
    return found


def _close(values: object, kept: object, tolerance: float, where: str = "") -> None:
    if isinstance(kept, dict):
        assert isinstance(values, dict)
        assert values.keys() == kept.keys(), where
        for key in kept:
            _close(values[key], kept[key], tolerance, f"{where} {key}")
    elif isinstance(kept, list):
        assert isinstance(values, list | tuple)
        assert len(values) == len(kept), where
        for k, (value, one) in enumerate(zip(values, kept, strict=True)):
            _close(value, one, tolerance, f"{where} [{k}]")
    elif isinstance(kept, float) and isinstance(values, float):
        assert values == pytest.approx(kept, rel=tolerance, abs=0.0), where
    else:
        assert values == kept, where


@pytest.mark.parametrize("kept", [*_cases("predictions", PREDICTED), *_cases("units", UNITS)])
def test_predictions_are_as_recorded(kept, request):
    found = recorded.prediction(kept["tables"])
    tolerance = 1e-9 if request.node.callspec.id in ROUNDED else 1e-12
    _close(found["requirements"], kept["requirements"], tolerance)
    # Coefficients of functions that are almost dependent carry rounding that what they predict together does not.
    _close(found["parameters"], kept["parameters"], 10.0 * tolerance)


@pytest.mark.parametrize("kept", _cases("judged", JUDGED))
def test_judgements_are_as_recorded(kept):
    """Verdicts with all that the spec omits and with another run, shares of errors, and chances; of a plan of one axis,
    recorded from a program for single axes."""
    found = recorded.judgement(kept["tables"])
    assert found["omitted"] == kept["omitted"]
    for name, expected in kept["requirements"].items():
        row = found["requirements"][name]
        shares, others = row.pop("shares", {}), expected.pop("shares", {})
        for source in {*shares, *others}:
            assert shares.get(source, 0.0) == pytest.approx(others.get(source, 0.0), abs=2e-9), source
        _close(row, expected, 1e-9, name)


# Sizes of a discrepancy were recorded as they act on the weights of the data, without what they leave themselves.
WRONGLY = {"static gradient 3": {"model discrepancy"}, "consumer 5": {"model discrepancy"}}


@pytest.mark.parametrize("kept", _cases("elasticities", DERIVED))
def test_elasticities_are_as_recorded(kept, request):
    rows, name = recorded.elasticities(kept["tables"]), request.node.callspec.id
    for requirement, figures in kept["rows"].items():
        assert set(figures) <= set(rows[requirement])
        for figure, expected in figures.items():
            if figure not in WRONGLY.get(name, ()):
                # Per cent for one per cent: all sizes of errors and priors together are one.
                assert abs(rows[requirement][figure] - expected) <= 3e-9 * max(abs(expected), 1.0), figure


@pytest.mark.parametrize("kept", [pytest.param(of, id=name) for name, of in KEPT["calibrations"].items()])
def test_exports_and_corrections_are_as_recorded(kept):
    found = recorded.calibration(kept["tables"])
    for target, export in kept["exports"].items():
        mine = found["exports"][target]
        assert mine.keys() == export.keys()
        if "refused" in export:
            continue
        # Exports in single precision are written with nine digits, of which the last may be rounded either way.
        tolerance = 1e-12 if target in ("kalibr", "matrices", "csv") else float(np.finfo(np.float32).eps)
        for row, expected in zip(mine["numbers"], export["numbers"], strict=True):
            # A row of a matrix is computed as a whole. In all other lines a number stands for itself.
            scale = np.max(np.abs(expected)) if target in ("kalibr", "matrices") else np.abs(expected)
            assert np.all(np.abs(np.subtract(row, expected)) <= tolerance * scale), (target, row, expected)
        for (*what, size, unit), (*name, expected, of) in zip(mine["losses"], export["losses"], strict=True):
            assert (what, unit) == (name, of)
            # A loss below a thousandth of its unit is the rounding of the written digits.
            assert size == pytest.approx(expected, rel=1e-9, abs=1e-3), (target, what)
    for what, values in kept["corrected"].items():
        largest = np.max(np.abs(values))
        assert np.max(np.abs(np.array(found["corrected"][what]) - values)) <= 1e-12 * largest, what


def _estimated(kept, found, std: float, apart: float, tests: float, names: dict[str, str]) -> None:
    """`apart`: how far a parameter may be from the recorded one, in standard deviations."""
    for sensor in kept.keys() - {"tables"}:
        mine, was = found[sensor], kept[sensor]
        assert mine["std"].keys() == was["std"].keys()
        _close(mine["std"], was["std"], std, sensor)
        for key, value in was["values"].items():
            scale = was["std"].get(key) or abs(value)
            assert abs(mine["values"][key] - value) <= max(1e-9 * abs(value), apart * scale), key
        for name, test in was["tests"].items():
            if names.get(name, name):
                _close(mine["tests"][names.get(name, name)], test, tests, f"{sensor} {name}")


@pytest.mark.long
@pytest.mark.parametrize("kept", [*_cases("estimates", ESTIMATED), *_cases("axis_estimates", AXES)])
def test_estimates_are_as_recorded(kept, request):
    name = request.node.callspec.id
    found = recorded.estimate(name.rstrip("0123456789"), kept["tables"])
    if any(test in TESTS_OF_AXES for of in kept.values() for test in of.get("tests", ())):
        # Another estimator recorded them: its regressors were sums of samples, as the simulated errors of these logs of
        # 5 rows a second are; now they are integrals of the motion that is interpolated between the rows. At points of
        # the standard method both are the same.
        loose = (1e-9, 1e-6, 1e-7) if name.startswith("axis standard") else (5e-4, 0.5, 0.1)
        return _estimated(kept, found, *loose, TESTS_OF_AXES)
    # An iteration ends when no parameter moves by more than a thousandth of its standard deviation, δ, so two ends are
    # up to 2δ apart; χ² moves by twice that times its root, and standard deviations with the products of errors.
    return _estimated(kept, found, 1e-6, 2e-3, 1e-3, {})
