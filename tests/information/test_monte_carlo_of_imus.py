"""Simulated calibrations of an IMU are as good as predicted."""

import pytest

from gradcal_jax.information.prediction import monte_carlo
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec


@pytest.mark.parametrize("name", ["ferraris", "paper-static-standard", "two-axis-table", "two-axis-table, geared"])
def test_simulated_calibrations_of_an_imu_are_as_predicted(name: str) -> None:
    preset, _, geared = name.partition(", ")
    spec = parse_spec(presets.text(preset))
    if geared:
        sizes = {"scale_error": "200 ppm", "backlash": "0.02 deg"}
        spec = changed(spec, {f"rig.table.axis[{k}].angle.{of}": size for k in (0, 1) for of, size in sizes.items()})
    rows = monte_carlo(spec, 400, seed=1)
    assert [row.name for row in rows] == [requirement.name for requirement in spec.requirement]
    for row in rows:
        # Of 400 runs a mean square is known to 7 %.
        assert row.simulated == pytest.approx(row.predicted, rel=0.15)


def test_too_few_runs_are_refused() -> None:
    with pytest.raises(ValueError, match="runs cannot test a covariance of 4 parameters: ask for 8 or more"):
        monte_carlo(parse_spec(presets.text("paper-static-standard")), 7)


def test_what_cannot_be_observed_is_refused() -> None:
    flat = {f"sensor.accelerometer.{name}.prior": None for name in ("bias", "scale_factor", "misalignment")}
    spec = parse_spec(presets.text("accelerometer-six-positions"))
    with pytest.raises(ValueError, match="give these parameters a prior"):
        monte_carlo(changed(spec, flat | {"plan.cycle.moves": [{"rest": "60 s"}]}), 400)
