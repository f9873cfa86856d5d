"""The filter in NumPy, reading by reading, is the filter in machine code and in blocks, and so is its derivative."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from gradcal_jax.information import NoiseSteps, adjoint, whiten_from
from gradcal_jax.information.by_reading import adjoint_parts, filter_readings
from gradcal_jax.information.compiled import compiler as find_compiler
from gradcal_jax.information.whitening import FilterState, block_length


def random_system(n: int, p: int, count: int) -> tuple[NoiseSteps, np.ndarray]:
    """Unused readings, readings without a step before them, and one that is known beforehand."""
    rng = np.random.default_rng([n, p, count])
    stays = (np.arange(count) > 0) & (rng.uniform(size=count) < 0.3)
    transition = np.eye(n) + 0.2 * rng.standard_normal((count, n, n)) / n
    root = 0.3 * rng.standard_normal((count, n, n))
    noise = root @ root.swapaxes(1, 2)
    transition[stays], noise[stays] = np.eye(n), 0.0
    observation, variance = rng.standard_normal((count, n)), rng.uniform(0.1, 1.0, count)
    used = rng.uniform(size=count) > 0.2
    observation[count // 2], variance[count // 2], used[count // 2] = 0.0, 0.0, True
    first = rng.standard_normal((n, n))
    steps = NoiseSteps(transition, noise, observation, variance, used, first @ first.T, stays)
    return steps, rng.standard_normal((count, p))


def assert_close(found, wanted, tolerance=1e-10):
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=tolerance * float(np.max(np.abs(wanted))))


@pytest.mark.parametrize(
    "sizes", [(1, 1, 3), (2, 16, 61), (4, 3, 40), pytest.param((9, 11, 30), marks=pytest.mark.evidence)]
)
def test_rows_state_and_derivative_are_those_of_the_blocks(sizes):
    n, p, count = sizes
    steps, columns = random_system(*sizes)
    start = np.random.default_rng(1).standard_normal((n, p))
    found = filter_readings(start, steps.initial, steps, columns)
    state, *known = jax.tree.map(jax.numpy.asarray, (FilterState(start, steps.initial), steps, columns))
    rows, after = jax.jit(whiten_from, static_argnames="block")(state, *known, block=block_length(count))
    assert_close(found.rows, rows)
    assert_close(found.mean, after.mean)
    assert_close(found.covariance, after.covariance)
    assert not found.rows[~steps.used].any()
    assert not found.rows[count // 2].any()

    found = filter_readings(np.zeros((n, p)), steps.initial, steps, columns)
    weights = np.random.default_rng(2).standard_normal((p, p))

    def weighed(covariance, variance, initial):
        now = known[0]._replace(covariance=covariance, reading_variance=variance, initial=initial)
        return jax.numpy.sum(weights * adjoint.gram(now, known[1]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRADCAL_NATIVE", "0")
        wanted = jax.jit(jax.grad(weighed, (0, 1, 2)))(known[0].covariance, known[0].reading_variance, known[0].initial)
    # ∂(weights · rowsᵀrows) by the adjoint states: −ρ W ρᵀ, −uᵀ W u.
    inner = (weights + weights.T) / 2
    parts = sorted(adjoint_parts(steps, found), key=lambda part: part[0].start)
    us, rhos = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    first = steps.transition[0].T @ rhos[0]
    mine = -rhos @ inner @ rhos.swapaxes(1, 2), -np.sum((us @ inner) * us, axis=1), -first @ inner @ first.T
    for own, theirs in zip(mine, wanted, strict=True):
        assert_close(own, theirs)


JOB = """
import sys
import numpy as np
sys.path.insert(0, {here!r})
from test_by_reading import random_system
from gradcal_jax.information import native, whiten
native._WORTH, native._BESIDE = {worth}, {beside}
for _ in range({times}):
    rows = whiten(*random_system(2, 3, 90))
    print(float(np.sum(rows**2)))
"""


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C++ compiler")
@pytest.mark.parametrize(("worth", "beside"), [(200, 200), (10**9, 200), (200, 100)])
def test_the_compiler_is_asked_once_its_work_is_worth_while_and_never_when_it_is_at_hand(tmp_path, worth, beside):
    """Beside NumPy, which goes on until it is done, or in its place: in any case once, for all later processes."""
    calls, command = tmp_path / "calls", tmp_path / "compiler"
    command.write_text(f'#!/bin/sh\necho "$*" >> {calls}\nexec {" ".join(find_compiler() or [])} "$@"\n')
    command.chmod(0o755)

    def run(times: int) -> tuple[list[float], int]:
        calls.write_text("")
        job = JOB.format(here=str(Path(__file__).parent), times=times, worth=worth, beside=beside)
        done = subprocess.run(
            [sys.executable, "-c", job],
            env=os.environ | {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu", "CXX": str(command)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return [float(line) for line in done.stdout.split()], calls.read_text().count(" -o ")

    few, compiled = run(beside // 90)
    assert compiled == 0
    assert len(set(few)) == 1
    more, compiled = run(3)
    assert compiled == 1
    assert more == pytest.approx([few[0]] * 3, rel=1e-12)
    at_hand, compiled = run(1)
    assert compiled == 0
    assert at_hand == pytest.approx(more[:1], rel=1e-12)
    # The third of them waited for the compiler.
    assert worth > 200 or at_hand[0] == more[2]
