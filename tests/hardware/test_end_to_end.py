"""From a recipe to a calibration: the run on simulated devices, the log, the estimate, and the hidden truth."""

import json
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import short_recipe
from hardware_evidence import record
from journal_log import log_of
from scipy.stats import chi2
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.calibration import Calibration, read_calibration
from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.run_folder import RunFolder, new_folder
from gradcal_jax.recipe.recipe import Recipe, read_recipe
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import write_log
from gradcal_jax.spec import presets

SMALL = {
    "sensor.gyro.scale_factor.temperature.degree": 1,
    "sensor.gyro.scale_factor.rate.degree": 1,
    "sensor.sample_clock_error": "20 ppm",
    "requirement": None,
}


def rehearsed(made: Recipe, folder: Path, seed: int) -> tuple[Log, dict[str, Any]]:
    """The log of a simulated run, and the hidden truth."""
    clock = VirtualClock()
    with SimulatedLab(made.spec, clock, seed=seed) as lab:
        run = new_folder(folder, made, lab.rig, simulated={"seed": seed})
        result = run_session(run, lab.rig, clock, simulated=True)
        assert (result.exit_status, result.reason, result.verified_safe) == ("success", "", True)
        truth = lab.truths()
    return log_of(run.contents(), run.recipe(), run.rig()), truth


def hidden_parameters(truth: dict[str, Any]) -> dict[str, float]:
    """Of the only device and of its installation, by their names in the calibration, SI."""
    return truth["units"]["unit1"] | truth["installation"]


def distance(calibration: Calibration, truth: dict[str, Any]) -> tuple[float, int]:
    """χ² of the estimate's errors in its own covariance, and its degrees of freedom."""
    values, hidden = calibration.values(), hidden_parameters(truth)
    assert calibration.covariance is not None
    names = calibration.covariance.names
    error = np.array([values[name] - hidden[name] for name in names])
    matrix = np.array(calibration.covariance.matrix)
    scale = np.sqrt(np.diag(matrix))
    whitened = np.linalg.solve(np.linalg.cholesky(matrix / np.outer(scale, scale)), error / scale)
    return float(whitened @ whitened), len(names)


def gradcal(*words: object) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, as users have it."""
    program = "import sys; from gradcal_jax.cli import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, words)], capture_output=True, text=True, check=False
    )


@pytest.mark.long
def test_a_short_run_gives_back_the_hidden_parameters_within_its_covariance(tmp_path: Path) -> None:
    made = short_recipe(changes=SMALL)
    log, truth = rehearsed(made, tmp_path / "run", seed=5)
    assert log.simulated
    assert log.axes == ("x", "y", "z")
    write_log(log, tmp_path / "log.nc")
    # In a process of its own: compiling under the tests' type checks would take a minute.
    said = gradcal(
        "estimate", tmp_path / "log.nc", "--recipe", tmp_path / "run/recipe.toml", "-o", tmp_path / "found.toml"
    )
    assert said.returncode in (0, 1), said.stderr
    calibration = read_calibration(tmp_path / "found.toml")
    assert calibration.simulated
    found, degrees = distance(calibration, truth)
    assert degrees == 4
    assert chi2.sf(found, degrees) > 1e-4
    # The test can fail: a truth that is ten deviations away is not consistent.
    assert calibration.covariance is not None
    name, variance = calibration.covariance.names[0], calibration.covariance.matrix[0][0]
    truth["units"]["unit1"][name] += 10.0 * float(np.sqrt(variance))
    assert chi2.sf(distance(calibration, truth)[0], degrees) < 1e-4


DESIGN = """
[design]
minimise = "full range"
starts   = 1
"""


@dataclass
class Chains:
    """Rehearsals of one recipe, seed by seed, from run to calibration: what the hidden truth says of each."""

    recipe: Path
    folder: Path
    statistic: list[float] = field(default_factory=list[float])
    degrees: int = 0
    fits: list[tuple[float, int]] = field(default_factory=list[tuple[float, int]])
    ratios: list[float] = field(default_factory=list[float])
    took_s: list[float] = field(default_factory=list[float])
    lasts_s: float = 0.0

    def add(self, seed: int, requirement: str) -> None:
        run, began = self.folder / f"run{seed}", time.monotonic()
        assert gradcal("run", self.recipe, "--simulate", "--seed", seed, "-o", run).returncode == 0
        self.took_s.append(time.monotonic() - began)
        assert gradcal("log", run).returncode == 0
        said = gradcal("estimate", run / "log.nc", "--recipe", self.recipe, "-o", run / "calibration.toml")
        assert said.returncode in (0, 1), said.stderr
        calibration = read_calibration(run / "calibration.toml")
        truth = json.loads((run / "hidden_truth.json").read_text(encoding="utf-8"))
        found, self.degrees = distance(calibration, truth)
        self.statistic.append(found)
        fit = calibration.fit[0]
        self.fits.append((fit.statistic, fit.degrees))
        predicted = next(row for row in read_recipe(self.recipe).prediction.requirements if row.name == requirement)
        row = next(row for row in calibration.result if row.name.startswith(requirement))
        # By what the spec names, as the prediction.
        reached = row.value if row.named is None else row.named
        assert predicted.mean_of_max is not None
        self.ratios.append(reached / predicted.mean_of_max)
        self.lasts_s = max(entry.time_s for entry in RunFolder(run).contents().records)
        (run / "journal").unlink()
        (run / "log.nc").unlink()

    @property
    def chance(self) -> float:
        return float(chi2.sf(sum(self.statistic), self.degrees * len(self.statistic)))

    def require_as_predicted(self, within: float) -> None:
        """Errors, data and residuals."""
        squares, degrees = np.sum(self.fits, axis=0)
        assert 0.001 < self.chance < 0.999, self.statistic
        assert 0.001 < chi2.sf(squares, degrees) < 0.999, self.fits
        # Data that the model explains with a chance below 1 % widen the covariance by the root of their χ² per degree:
        # of a few seeds one may.
        wider = np.array([np.sqrt(s / d) if chi2.sf(s, d) < 0.01 else 1.0 for s, d in self.fits])
        assert np.count_nonzero(wider > 1.0) <= 1, self.fits
        assert np.all(np.abs(np.array(self.ratios) / wider - 1.0) < within), self.ratios

    def words(self) -> str:
        found, took_s = self.statistic, float(np.median(self.took_s))
        return (
            f"{len(found)} seeds: χ² of the hidden truth {sum(found):.0f} of {self.degrees * len(found)} degrees "
            f"(chance {self.chance:.2f}; each {min(found):.1f} to {max(found):.1f} of {self.degrees}), of the data "
            f"{sum(s for s, _ in self.fits):.0f} of {sum(d for _, d in self.fits)}; residual over prediction "
            f"{min(self.ratios):.3f} to {max(self.ratios):.3f}; {self.lasts_s / 3600.0:.2f} h of virtual "
            f"time took {took_s:.0f} s, {self.lasts_s / took_s:.0f} times faster than real time"
        )


@pytest.mark.evidence
def test_hidden_truth_of_the_headline_recipe_lies_within_the_covariance(tmp_path: Path) -> None:
    """The paper's case, optimised, on simulated chamber, table and STIM300, some seeds: χ² of all coefficients."""
    spec, recipe = tmp_path / "spec.toml", tmp_path / "recipe.toml"
    spec.write_text(presets.text("paper-dynamic-gradient") + DESIGN, encoding="utf-8")
    # Status 1: thirty steps are not always enough to converge; what was found is a sound recipe.
    assert gradcal("optimise", spec, "--steps", 30, "-o", recipe).returncode in (0, 1)
    made = read_recipe(recipe)
    assert not made.status.startswith("not optimised")
    chains = Chains(recipe, tmp_path)
    for seed in range(1, 5):
        chains.add(seed, "full range")
    chains.require_as_predicted(0.1)
    predicted = next(row for row in made.prediction.requirements if row.name == "full range")
    record(
        "headline recipe end to end, STIM300 at 125 samples/s",
        f"recipe by `gradcal optimise`, {predicted.mean_of_max:.2f} ppm predicted; {chains.words()}",
        "tests/hardware/test_end_to_end.py",
    )


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("preset", "requirement", "within", "what"),
    [
        # Rates that nobody chose.
        ("rig-hand", "scale factor", 0.15, "a simulated person turns the gimbal, an encoder is read"),
        ("paper-dynamic-standard", "full range", 0.1, "the standard method"),
    ],
)
def test_hidden_truth_of_a_preset_lies_within_the_covariance(tmp_path: Path, preset, requirement, within, what) -> None:
    """By hand: uneven, late, now and then mistyped. The standard method: a soak and six rates at each temperature."""
    spec, recipe = tmp_path / "spec.toml", tmp_path / "recipe.toml"
    spec.write_text(presets.text(preset), encoding="utf-8")
    assert gradcal("optimise", spec, "--steps", "0", "-o", recipe).returncode in (0, 1)
    chains = Chains(recipe, tmp_path)
    for seed in range(1, 4):
        chains.add(seed, requirement)
    chains.require_as_predicted(within)
    record(f"preset {preset} end to end, {what}", chains.words(), "tests/hardware/test_end_to_end.py")
