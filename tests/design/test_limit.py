"""No plan is ever below its proven limit: random plans, sensors and programmes, and other plans on the same rig.

A case is a plan of `random_plans`. Its limit is held against what its own plan leaves, and against plans that no
search of ours would make: the same timetable with other angles, rates and directions.
"""

import copy

import numpy as np
import pytest
from random_plans import SCALE, plan_of

from gradcal_jax.design.noise_floor import least_noise_density
from gradcal_jax.design.plan_limit import limit
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.noise import gauss_markov
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.tables.problems import SpecError

# Certificates are computed to a duality gap; rounding of the engine is far below.
SLACK = 1e-6
# 1 and 15: a degree-0 spline, whose jump a look at a slow process sees as it is. 11: near its limit.
ALWAYS = [("axis", seed) for seed in (1, 11, 15, 24)] + [("unit", seed) for seed in (0, 1)]
REFUSALS = (
    "polynomial in rate",
    "a limit is proven",
    "cannot",
    "no proof",
    "not observ",
)


def other_plan(document: dict, rng: np.random.Generator) -> dict:
    """The same timetable, each turn with another angle, direction and shape, at most as fast."""
    changed = copy.deepcopy(document)
    for move in changed["plan"]["cycle"]["moves"]:
        if "turn" not in move:
            continue
        share = float(rng.uniform(0.15, 1.0)) * float(rng.choice([-1.0, 1.0]))
        for key in ("turn", "peak_rate"):
            if key in move:
                number, unit = move[key].split(" ", 1)
                size = float(number) * (share if key == "turn" else abs(share))
                move[key] = f"{size:.6g} {unit}"
    return changed


def values_of(document: dict) -> dict[tuple[str, str], float | None] | None:
    """What a plan leaves of every requirement; None where it is no valid plan."""
    try:
        spec = spec_of(document)
    except SpecError:
        return None
    return {(row.name, row.axis): getattr(row, row.statistic.replace(" ", "_")) for row in predict(spec).requirements}


def check(kind: str, seed: int) -> tuple[str, float]:
    """What became of a case ("held", or the refusal's sentence), and the least residual over its limit."""
    rng, document = np.random.default_rng(50_000 + seed), plan_of(kind, seed, terms=kind == "axis")
    if kind == "unit":
        document["requirement"].append(SCALE | {"statistic": "max"})
    try:
        proven = limit(spec_of(document))
    except ValueError as error:
        said = str(error)
        if not any(word in said for word in REFUSALS):
            raise
        return said, np.inf
    plans = [document, other_plan(document, rng)]
    least = np.inf
    for plan in plans:
        found = values_of(plan)
        if found is None:
            continue
        for one in proven:
            assert one.certified > 0.0
            assert np.isfinite(one.certified)
            for (name, axis), value in found.items():
                if name == one.name and value is not None:
                    assert value >= one.certified * (1.0 - SLACK), (seed, name, axis, value, one)
                    least = min(least, value / one.certified)
    return "held", least


def test_the_floor_of_the_noise_is_its_formula():
    """max_ε min_λ N² + 2σ²τ/(1 + λ²τ²) + R λ²/(1/Δ + ε/2 + λ²/(2ε)), on other grids."""
    walk, sigma, tau, reading, spacing = 2e-5, 5e-6, 120.0, 1e-3, 4.0
    rates, epsilons = np.geomspace(1e-6, 1e2, 3000), np.geomspace(1e-5, 1e3, 400)[:, None]
    noise = walk**2 + 2.0 * sigma**2 * tau / (1.0 + (rates * tau) ** 2)
    window = 1.0 / spacing + epsilons / 2.0 + rates**2 / (2.0 * epsilons)
    wanted = np.max(np.min(noise + reading**2 * rates**2 / window, axis=1))
    found = least_noise_density(walk, gauss_markov(sigma, tau), reading, spacing)
    assert wanted > 1.5 * walk**2
    assert found == pytest.approx(wanted, rel=2e-2)


@pytest.mark.parametrize(("kind", "seed"), ALWAYS)
def test_no_plan_is_below_its_limit(kind, seed):
    said, least = check(kind, seed)
    assert said != "held" or least >= 1.0 - SLACK


@pytest.mark.evidence
@pytest.mark.parametrize(("kind", "part"), [*(("axis", part) for part in range(10)), ("unit", 0), ("unit", 1)])
def test_no_plan_of_six_hundred_is_below_its_limit(kind, part):
    """500 of a gyro's axis; 100 of a unit, whose limit takes some seconds."""
    cases = [check(kind, seed) for seed in range(50 * part, 50 * (part + 1))]
    refused = {said for said, _ in cases if said != "held"}
    held = [least for said, least in cases if said == "held" and np.isfinite(least)]
    print(f"{kind} {part}: {len(held)} of {len(cases)} held, nearest {min(held):.4f}; refused: {refused or 'none'}")
    assert len(held) >= 10
