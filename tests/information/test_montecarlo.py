"""The Monte Carlo twin: 2000 simulated calibrations scatter as the prediction says, around the truth."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import SCENES, core
from scipy.stats import chi2

from gradcal_jax.information import at_readings, noise_steps, simulated_errors

RUNS = 2000


def monte_carlo_errors(line, model, runs: int, seed: int = 0):
    system = noise_steps(line, model), at_readings(line, model)
    return simulated_errors(*system, model.prior_rows(), np.ones(model.size, bool), runs, seed)


def check(line, model, runs: int, seed: int = 1) -> None:
    result = monte_carlo_errors(line, model, runs, seed=seed)
    p = result.errors.shape[1]
    white = np.linalg.lstsq(result.predicted.spread, result.errors.T, rcond=None)[0]
    # The sum of squares is χ², which a covariance that is wrong by a tenth exceeds by far.
    assert chi2.ppf(5e-4, runs * p) < np.sum(white**2) < chi2.ppf(1.0 - 5e-4, runs * p)
    # The eigenvalues of a Wishart matrix lie between (1 ± √(p/runs))², and beyond that by a few n^(−2/3).
    values = np.linalg.eigvalsh(white @ white.T / runs)
    assert np.all(np.abs(np.sqrt(values) - 1.0) < np.sqrt(p / runs) + 5.0 / np.sqrt(runs))
    mean = np.linalg.lstsq(result.predicted.spread, result.errors.mean(0), rcond=None)[0]
    assert runs * np.sum(mean**2) < chi2.ppf(0.999, p)


def test_the_empirical_covariance_is_the_predicted_one():
    scene = replace(SCENES["gap"], timing=1e-4)
    plan, model = core(scene)
    check(plan.trajectory(), model, RUNS)


def test_what_cannot_be_observed_is_refused():
    scene = replace(SCENES["gap"], moves=SCENES["gap"].moves[:1], scale_prior=np.inf)
    plan, model = core(scene)
    with pytest.raises(ValueError, match="cannot observe"):
        monte_carlo_errors(plan.trajectory(), model, 10)


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["paper-dynamic-gradient", "paper-dynamic-standard", "tactical-mems"])
def test_the_papers_full_plans(name):
    from gradcal_jax.model import build
    from gradcal_jax.spec import presets
    from gradcal_jax.spec import spec as spec_file

    spec = spec_file.parse_spec(presets.text(name))
    built = build.assemble(spec)
    check(built.trajectory(), built.model, RUNS)
