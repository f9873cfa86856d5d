"""Three roads to one covariance: whitening, dense generalised least squares, the paper's augmented Kalman filter."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    DEG,
    DEG_PER_H,
    SCENES,
    Act,
    Bins,
    BSpline,
    Engine,
    Noise,
    Polynomial,
    Scene,
    augmented_kalman,
    core,
    core_model,
    dense_gls,
    deviations,
    engine,
    engine_of,
    prior_rows_reported,
    reference,
    traced_engine_of,
    varied,
)

from gradcal_jax.information.noise_steps import NoiseSteps

ANGLE_UNITS = {"rad": 1.0, "deg": 1.0 / DEG, "arcsec": 3600.0 / DEG}


def in_unit(steps: NoiseSteps, columns, factor: float):
    """Everything that is an angle, measured in another unit: noise, readings and regressors alike."""
    square = factor**2
    scaled = steps._replace(
        covariance=steps.covariance * square,
        reading_variance=steps.reading_variance * square,
        initial=steps.initial * square,
    )
    return scaled, columns * factor


def compare_with_dense(scene: Scene, made: Engine) -> np.ndarray:
    reported = core_model(scene).to_reported
    slow = reference(scene)
    used = np.asarray(made.steps.used)
    columns = np.asarray(made.columns)[used] @ np.linalg.inv(reported)
    assert columns.shape == slow.regressors.shape
    size = np.max(np.abs(slow.regressors), axis=0)
    size = np.where(size > 0.0, size, 1.0)  # A bin that the plan never visits.
    assert np.max(np.abs(columns - slow.regressors) / size) < 1e-11
    dense, _ = dense_gls(slow.regressors, slow.covariance, prior_rows_reported(scene, columns.shape[1]))
    found = made.deviations(reported)
    np.testing.assert_allclose(found, dense, rtol=1e-9, atol=0)
    return found


def compare_with_kalman(scene: Scene, made: Engine, found: np.ndarray, tolerance: float) -> None:
    reported = core_model(scene).to_reported
    rows = np.asarray(made.prior)
    inverse = np.linalg.inv(rows)
    covariance = reported @ augmented_kalman(made.steps, made.columns, inverse @ inverse.T) @ reported.T
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), found, rtol=tolerance, atol=0)


def compare_in_single_precision(steps: NoiseSteps, columns, prior, reported, found: np.ndarray) -> None:
    single = jax.tree.map(
        lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x,
        (steps, columns, prior, reported),
    )
    rough = deviations(*single)
    assert rough.dtype == jnp.float32
    np.testing.assert_allclose(rough, found, rtol=1e-3, atol=0)


@pytest.mark.parametrize("name", SCENES)
def test_both_array_libraries_compute_the_same(name):
    """NumPy at once, and JAX with the whole plan and model as arguments: steps, regressors and priors."""
    plan, model = core(SCENES[name])
    lag = SCENES[name].lag
    for ours, theirs in zip(
        jax.tree.leaves(engine_of(plan, model, lag)), jax.tree.leaves(traced_engine_of(plan, model, lag)), strict=True
    ):
        size = np.max(np.abs(ours), axis=0, initial=0.0)
        np.testing.assert_allclose(
            np.asarray(theirs, float) / np.where(size > 0, size, 1.0), ours / np.where(size > 0, size, 1.0), atol=1e-12
        )


@pytest.mark.parametrize("name", SCENES)
def test_whitening_is_dense_least_squares_in_every_unit_and_precision(name):
    rng = np.random.default_rng(len(name))
    for scene in (SCENES[name], varied(SCENES[name], rng), varied(SCENES[name], rng)):
        made = engine(scene)
        found = compare_with_dense(scene, made)
        if made.prior.shape[0] == made.columns.shape[1]:
            compare_with_kalman(scene, made, found, 1e-9)
    reported = jnp.asarray(core_model(scene).to_reported)
    for factor in ANGLE_UNITS.values():
        steps, columns = in_unit(made.steps, made.columns, factor)
        here = deviations(steps, columns, made.prior, reported)
        np.testing.assert_allclose(here, found, rtol=1e-9, atol=0)
        if name not in ("everything", "bases"):
            # One compilation in single precision for each size of state is enough; the evidence takes them all.
            compare_in_single_precision(steps, columns, made.prior, reported, found)


@pytest.mark.parametrize(("prior", "tolerance"), [(1e-4, 1e-9), (1e-2, 1e-9), (10.0, 1e-5)])
def test_the_augmented_filter_meets_whitening_as_far_as_its_priors_let_it(prior, tolerance):
    """The textbook filter subtracts covariances: of its variances, of which the posterior is the square of 1e-6 of the
    prior for a prior of 10, rounding leaves 1e-16 · 1e12 at worst."""
    scene = replace(SCENES["paper-like"], scale_prior=prior)
    made = engine(scene)
    compare_with_kalman(scene, made, compare_with_dense(scene, made), tolerance)


def test_the_basis_scaling_does_not_matter():
    scene = SCENES["paper-like"]
    # Twice the scales, no prior: a coefficient of degree (i, j) grows by 2^(i + j).
    flat = replace(scene, scale_prior=np.inf)
    wide = replace(flat, scale=(Polynomial(1, 20.0, 100.0), Polynomial(3, 0.0, 600.0 * DEG)))
    small, large = (engine(s).deviations(core_model(s).to_reported) for s in (flat, wide))
    growth = np.add.outer(np.arange(2), np.arange(4)).ravel()
    np.testing.assert_allclose(large, small * 2.0**growth, rtol=1e-10, atol=0)


# --- random plans -----------------------------------------------------------------------------------------------------


def random_scene(rng: np.random.Generator) -> Scene:
    """Any shape, noise mixture, reference, basis and structure, within what an hour's plan could be."""
    shapes = ("cosine ramps", "linear ramps", "hand", "rest")
    uniform = lambda a, b: float(rng.uniform(a, b))  # noqa: E731
    moves = []
    for shape in [*rng.choice(shapes[:-1], size=3), *rng.choice(shapes, size=int(rng.integers(1, 4)))]:
        duration = uniform(3.0, 12.0)
        every = uniform(1.0, 4.0) if rng.random() < 0.3 else None
        if shape == "rest":
            moves.append(Act("rest", duration, every=uniform(1.0, 4.0)))
            continue
        moves.append(
            Act(
                str(shape),
                duration,
                uniform(-300, 300) * DEG,
                ramp=uniform(0.3, duration / 2),
                unevenness=uniform(0, 0.4),
                axis="y" if rng.random() < 0.15 else "x",
                every=every,
                others_every=uniform(1.0, 3.0) if rng.random() < 0.5 else None,
            )
        )
    noises = [
        Noise("drift", uniform(0.3, 5) * DEG_PER_H, uniform(20, 1000)),
        Noise("drift", uniform(0.3, 20) * DEG_PER_H, uniform(1.5, 50)),
        Noise("walk", uniform(0.003, 0.1) * DEG_PER_H),
        Noise("constant", uniform(1, 5) * DEG_PER_H),
        Noise("constant", uniform(1e-6, 1e-4), bias_gain=0.0, rate_gain=1.0),
        Noise("scale", uniform(5e-6, 1e-4), uniform(30, 1000), 0.0, 1.0),
        Noise("both", uniform(0.02, 0.3), uniform(50, 900), uniform(-5, 5) * DEG_PER_H, uniform(-3e-5, 3e-5)),
    ]
    noises = [n for n in noises if rng.random() < 0.4]
    period = sum(a.duration for a in moves)
    after = (Act("rest", uniform(5, 20), every=uniform(2, 5)),) if rng.random() < 0.7 else ()
    period += sum(a.duration for a in after)
    first = period * uniform(1.2, 2.2)
    stretches = ((first, uniform(0.1, 0.4)), (uniform(5, 40), 0.0), (period * uniform(1.1, 2.0), uniform(-0.3, 0.3)))
    temperature = [Polynomial(1, 20.0, 50.0), Polynomial(2, 10.0, 40.0), BSpline((-60.0, 0.0, 60.0), 1)]
    rates = [Polynomial(1, 0.0, 5.0), Polynomial(2, 0.0, 6.0), Polynomial(3, 0.0, 5.0), Bins((-9.0, -1.5, 1.5, 9.0))]
    biases = [None, Polynomial(1, 20.0, 50.0), Bins((-60.0, 10.0, 60.0))]
    scale_time = [n.tau for n in noises if n.rate_gain]
    return Scene(
        uniform(-30, 20),
        stretches,
        tuple(moves),
        after,
        used=((0, 1), (2, 3)) if rng.random() < 0.4 else None,
        read_every=uniform(2, 6) if rng.random() < 0.8 else None,
        lag=uniform(5, 200) if rng.random() < 0.4 else None,
        arw=uniform(0.02, 0.5) * DEG / 60,
        noises=tuple(noises),
        reading_noise=uniform(0.001, 0.1) * DEG,
        offset=uniform(0.001, 0.05) * DEG if rng.random() < 0.5 else 0.0,
        timing=uniform(1e-5, 1e-3),
        harmonics={int(rng.integers(1, 4)): uniform(0.002, 0.02) * DEG} if rng.random() < 0.3 else {},
        bias=biases[int(rng.integers(3))],
        scale=(temperature[int(rng.integers(3))], rates[int(rng.integers(4))]),
        bias_prior=500 * DEG_PER_H,
        scale_prior=1e-2,
        longest_piece=3.0 * min(scale_time, default=np.inf),
    )


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(60))
def test_random_plans(seed):
    scene = random_scene(np.random.default_rng(seed))
    made = engine(scene)
    found = compare_with_dense(scene, made)
    # The textbook filter itself loses up to 2e-9 here, in float64; the dense road, in 80 bits, is the judge.
    compare_with_kalman(scene, made, found, 1e-8)
    compare_in_single_precision(made.steps, made.columns, made.prior, jnp.asarray(core_model(scene).to_reported), found)
    jax.clear_caches()


@pytest.mark.evidence
@pytest.mark.parametrize("name", SCENES)
def test_single_precision_in_every_unit(name):
    made = engine(SCENES[name])
    found = compare_with_dense(SCENES[name], made)
    for factor in ANGLE_UNITS.values():
        steps, columns = in_unit(made.steps, made.columns, factor)
        compare_in_single_precision(
            steps, columns, made.prior, jnp.asarray(core_model(SCENES[name]).to_reported), found
        )
