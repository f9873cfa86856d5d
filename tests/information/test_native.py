"""The filter in machine code is the filter in blocks: values, every derivative, every way of calling it."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.information import (
    FilterState,
    NoiseSteps,
    SquareRootInformation,
    adjoint,
    gram,
    native,
    whiten,
    whiten_from,
    whitened_factor,
    whitening,
)
from gradcal_jax.information.compiled import compiler as find_compiler
from gradcal_jax.information.whitening import block_length

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C++ compiler")

# States, columns, readings: one of each; panels that are not full, full, and more than one; more states than columns.
SHAPES = [(1, 1, 1), (2, 16, 61), (3, 5, 40), (2, 19, 100), (5, 3, 57), (9, 11, 40)]


def system(n: int, p: int, count: int, seed: int = 0, dtype=np.float64) -> tuple[NoiseSteps, jax.Array]:
    """A random stable system with unused readings and, in the middle, one that is known beforehand."""
    rng = np.random.default_rng([n, p, count, seed])
    transition = np.eye(n) + 0.2 * rng.standard_normal((count, n, n)) / n
    root = 0.3 * rng.standard_normal((count, n, n))
    noise = root @ root.swapaxes(1, 2)
    observation, variance = rng.standard_normal((count, n)), rng.uniform(0.1, 1.0, count)
    used = rng.uniform(size=count) > 0.2
    if count > 10:
        observation[count // 2], variance[count // 2], used[count // 2] = 0.0, 0.0, True
    first = rng.standard_normal((n, n))
    floats = (transition, noise, observation, variance)
    steps = NoiseSteps(*(jnp.asarray(x, dtype) for x in floats), jnp.asarray(used), jnp.asarray(first @ first.T, dtype))
    return steps, jnp.asarray(rng.standard_normal((count, p)), dtype)


def shared(p: int, count: int) -> tuple[NoiseSteps, jax.Array]:
    """Ten states of which few meet, and readings that follow one another without a step."""
    steps, columns = system(10, p, count)
    rng = np.random.default_rng(5)
    few = np.where(rng.uniform(size=(count, 10, 10)) < 0.15, np.asarray(steps.transition), 0.0) + 0.5 * np.eye(10)
    stays = (np.arange(count) % 4 > 0)[:, None, None]
    return steps._replace(
        transition=jnp.asarray(np.where(stays, np.eye(10), few)),
        covariance=jnp.where(stays, 0.0, steps.covariance),
        observation=jnp.where(rng.uniform(size=(count, 10)) < 0.4, steps.observation, 0.0),
    ), columns


def weights(p: int):
    """A cotangent of the product that is not symmetric."""
    return jnp.asarray(np.random.default_rng(p).standard_normal((p, p)))


def floats(steps: NoiseSteps):
    return (*steps[:4], steps.initial)


def with_floats(steps: NoiseSteps, values) -> NoiseSteps:
    return NoiseSteps(*values[:4], steps.used, values[4], steps.stays)


def value(steps: NoiseSteps, columns, values):
    return jnp.sum(weights(columns.shape[1]) * gram(with_floats(steps, values), columns))


def compiled(function, *arguments):
    """Traced afresh at every call, and not found where it was traced with other settings."""
    return jax.jit(lambda *a: function(*a))(*arguments)


@pytest.fixture
def in_blocks(monkeypatch):
    """`compiled` without machine code."""

    def call(function, *arguments):
        with monkeypatch.context() as patch:
            patch.setenv("GRADCAL_NATIVE", "0")
            return compiled(function, *arguments)

    return call


def close(found, wanted, tolerance=1e-10):
    for f, w in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert f.dtype == w.dtype
        np.testing.assert_allclose(f, w, rtol=0.0, atol=tolerance * float(np.max(np.abs(w), initial=1e-300)))


@pytest.mark.parametrize("shape", SHAPES)
def test_rows_and_the_state_after_them(shape):
    n, p, count = shape
    steps, columns = system(*shape)
    rng = np.random.default_rng(1)
    state = FilterState(jnp.asarray(rng.standard_normal((n, p))), steps.initial)
    assert native.native(steps, columns, *state) is not None
    rows, after = compiled(whiten_from, state, steps, columns)
    wanted_rows, wanted = compiled(partial(whiten_from, block=block_length(count)), state, steps, columns)
    close(rows, wanted_rows)
    close(after, wanted)
    assert not np.any(np.asarray(rows)[~np.asarray(steps.used)])
    if count > 10:
        assert not np.any(np.asarray(rows)[count // 2])


@pytest.mark.long
@pytest.mark.parametrize("shape", [*SHAPES[:-1], pytest.param(SHAPES[-1], marks=pytest.mark.evidence), None])
def test_the_gradient_in_everything(shape, in_blocks):
    steps, columns = shared(19, 41) if shape is None else system(*shape)

    def gradient(values, columns):
        return jax.grad(lambda v, c: value(steps, c, v), argnums=(0, 1))(values, columns)

    found = compiled(gradient, floats(steps), columns)
    close(found, in_blocks(gradient, floats(steps), columns))


def test_where_no_step_leads_to_a_reading_the_rest_of_the_gradient_is_the_same():
    steps, columns = shared(19, 41)
    stays = np.arange(41) % 4 > 0

    def gradient(steps):
        return compiled(
            lambda v, c: jax.grad(lambda v, c: value(steps, c, v), argnums=(0, 1))(v, c), floats(steps), columns
        )

    (transition, noise, *rest), of_columns = gradient(steps)
    (fewer, fewer_noise, *same), of_columns_too = gradient(steps._replace(stays=stays))
    assert not np.any(fewer[stays])
    assert not np.any(fewer_noise[stays])
    close(
        (fewer[~stays], fewer_noise[~stays], same, of_columns_too),
        (transition[~stays], noise[~stays], rest, of_columns),
    )


def test_the_factor_of_the_rows_too(in_blocks):
    steps, columns = system(2, 5, 61)
    below = jnp.asarray(np.random.default_rng(2).standard_normal((3, 5)))

    def all_of_it(values, columns, below):
        def f(v, c, b):
            factor, scale, _ = whitened_factor(with_floats(steps, v), c, b)
            return jnp.sum(weights(5) * factor * scale[None, :])

        return jax.value_and_grad(f, argnums=(0, 1, 2))(values, columns, below)

    found = compiled(all_of_it, floats(steps), columns, below)
    close(found, in_blocks(all_of_it, floats(steps), columns, below))


def test_the_inverse_has_the_derivative_that_the_factor_tells():
    steps, columns = system(2, 5, 61)
    below = jnp.asarray(np.random.default_rng(2).standard_normal((3, 5)))

    def variance(told, columns):
        info = SquareRootInformation(*whitened_factor(steps, columns, below))
        info = info if told else info._replace(inverse=None)
        return jnp.sum(weights(5) * info.covariance())

    by_inverse, by_factor = (compiled(jax.value_and_grad(partial(variance, told)), columns) for told in (True, False))
    close(by_inverse, by_factor)


def test_nothing_finite_is_said_of_what_no_reading_tells():
    steps, columns = system(2, 5, 61)
    none = jnp.zeros((0, 5))
    info = SquareRootInformation(*whitened_factor(steps, columns.at[:, 2].set(0.0), none))
    assert not np.isfinite(info.covariance()[2, 2])

    def of_others(columns):
        factor, _, _ = whitened_factor(steps, columns.at[:, 2].set(0.0), none)
        return jnp.sum(factor**2)

    assert np.all(np.isfinite(jax.grad(of_others)(columns)))


@pytest.mark.parametrize(
    ("outer", "inner"),
    [
        (jax.grad, jax.jacfwd),
        *(pytest.param(outer, jax.grad, marks=pytest.mark.evidence) for outer in (jax.jacfwd, jax.grad)),
        pytest.param(jax.jacfwd, jax.jacfwd, marks=pytest.mark.evidence),
    ],
)
def test_forwards_backwards_and_twice(in_blocks, outer, inner):
    """Every mode of differentiation agrees with the blocks', whose second derivatives are JAX's own."""
    steps, columns = system(1, 2, 12)

    def along(s):
        return value(steps, columns * (1.0 + s), jax.tree.map(lambda x: x * (1.0 + 0.1 * s), floats(steps)))

    zero = jnp.zeros(())
    slope = in_blocks(lambda: jax.grad(along)(zero))
    twice = in_blocks(lambda: jax.grad(jax.grad(along))(zero))
    found = compiled(lambda: (jax.jacfwd(along)(zero), jax.grad(along)(zero)))
    close(found, (slope, slope))
    close(compiled(outer(inner(along)), zero), twice)


def test_many_problems_side_by_side():
    """Over the noise, over the columns alone, over both, and in chunks: each as if it were alone."""
    made = [system(2, 5, 33, seed) for seed in range(6)]
    steps = jax.tree.map(lambda *x: jnp.stack(x), *(s for s, _ in made))
    columns = jnp.stack([c for _, c in made])
    wanted = jnp.stack([gram(s, c) for s, c in made])
    close(jax.vmap(gram)(steps, columns), wanted)
    close(jax.lax.map(lambda x: gram(*x), (steps, columns), batch_size=4), wanted)
    one = made[0][0]
    close(jax.vmap(gram, (None, 0))(one, columns), jnp.stack([gram(one, c) for _, c in made]))
    table = jax.vmap(jax.vmap(gram, (None, 0)), (0, None))(steps, columns)
    close(table[2, 4], gram(made[2][0], made[4][1]))

    def gradient(s, c):
        return jax.grad(lambda v, c: value(s, c, v), argnums=(0, 1))(floats(s), c)

    found = jax.jit(jax.vmap(gradient))(steps, columns)
    for i, (s, c) in enumerate(made):
        close(jax.tree.map(lambda x, i=i: x[i], found), gradient(s, c))


def test_rows_have_the_derivative_of_the_blocks():
    steps, columns = system(2, 5, 40)
    d_columns = jnp.cos(columns)

    def rows(block):
        def f(values, c):
            return whiten(with_floats(steps, values), c, block=block)

        return compiled(lambda: jax.jvp(f, (floats(steps), columns), (floats(steps), d_columns)))

    close(rows(None), rows(block_length(40)))


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 19, 100), (3, 5, 40), pytest.param(None, marks=pytest.mark.evidence)])
def test_programs_for_other_devices_compute_the_same_without_machine_code(shape):
    """What a program for another device would do, done on this one."""
    steps, columns = shared(19, 41) if shape is None else system(*shape)
    state = FilterState(jnp.ones((steps.observation.shape[1], columns.shape[1])), steps.initial)
    close(compiled(whitening._in_blocks, state, steps, columns), compiled(whitening._natively, state, steps, columns))
    by_code, in_blocks = (compiled(f, steps, columns) for f in (adjoint._kept_natively, adjoint._kept_in_blocks))
    # Where no step leads to the next reading, the code keeps no state.
    close(in_blocks[:1] if shape is None else in_blocks, by_code[:1] if shape is None else by_code)
    pulled = compiled(adjoint._pulled_in_blocks, steps, *in_blocks, weights(columns.shape[1]))
    wanted = compiled(adjoint._pulled_natively, steps, *by_code, weights(columns.shape[1]))
    if shape is None:  # Nobody asks for what a step that is none would change.
        pulled, wanted = pulled[2:], wanted[2:]
    close(pulled, tuple(wanted))


def test_the_platform_that_a_program_is_lowered_for_decides_not_the_one_where_it_is_traced():
    steps, columns = system(3, 7, 400)
    batch = jnp.stack([columns, 2.0 * columns])
    gradients = jax.grad(lambda c: jnp.sum(jax.vmap(partial(gram, steps))(c)))

    def calls_and_loops(function, platform):
        text = str(jax.jit(function).trace(batch).lower(lowering_platforms=(platform,)).as_text())
        return text.count("@gradcal_"), text.count("stablehlo.while")

    assert calls_and_loops(gradients, "cpu")[0] == 2
    calls, loops = calls_and_loops(gradients, "cuda")
    assert calls == 0
    assert loops > 5
    assert calls_and_loops(lambda c: whiten(steps, c[0]), "cpu") == (1, 0)
    assert calls_and_loops(lambda c: whiten(steps, c[0]), "cuda")[0] == 0


def test_single_precision():
    steps, columns = system(2, 19, 100, dtype=np.float32)
    assert native.native(steps, columns) is not None
    found = jax.grad(lambda c: jnp.sum(gram(steps, c)))(columns)
    assert found.dtype == jnp.float32
    wide = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, (steps, columns))
    wanted = jax.grad(lambda c: jnp.sum(gram(wide[0], c)))(wide[1])
    np.testing.assert_allclose(found, wanted, atol=1e-4 * float(jnp.max(jnp.abs(wanted))))


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype float64")
def test_doubles_while_jax_makes_none():
    steps, columns = system(2, 5, 61)
    wanted = gram(steps, columns)
    with jax.enable_x64(False):
        found, within = gram(steps, columns), compiled(gram, steps, columns)
    assert found.dtype == within.dtype == jnp.float32
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(within, wanted, rtol=1e-4, atol=1e-4)


def test_mixed_precision_is_left_to_jax():
    steps, columns = system(2, 5, 40)
    assert native.native(steps, columns.astype(jnp.float32)) is None


PROGRAM = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, {here!r})
from test_native import gram, native, system
steps, columns = system(2, 5, 61)
has = "@gradcal_" in jax.jit(gram).lower(steps, columns).as_text()
print(has, float(jax.jit(gram)(steps, columns)[1, 2]))
"""


def told(cache: Path, **environment: str) -> tuple[bool, float, str]:
    """A process of its own: whether it has machine code, a number, and what it complains of."""
    program = PROGRAM.format(here=str(Path(__file__).parent))
    kept = {k: v for k, v in os.environ.items() if k not in ("CXX", "GRADCAL_NATIVE")}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=kept | {"XDG_CACHE_HOME": str(cache), "JAX_PLATFORMS": "cpu"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    has, number = done.stdout.split()
    return has == "True", float(number), done.stderr


def test_what_is_compiled_once_is_kept_and_a_damaged_file_made_again(tmp_path):
    calls = tmp_path / "calls"
    compiler = tmp_path / "compiler"
    real = " ".join(find_compiler() or [])
    compiler.write_text(f'#!/bin/sh\necho "$*" >> {calls}\nexec {real} "$@"\n')
    compiler.chmod(0o755)

    def times_called() -> int:
        return sum(" -o " in line for line in calls.read_text().splitlines())

    wanted = float(gram(*system(2, 5, 61))[1, 2])
    for expected in (1, 1):
        has, number, complaint = told(tmp_path, CXX=str(compiler))
        assert has
        assert number == pytest.approx(wanted, rel=1e-14)
        assert "RuntimeWarning" not in complaint
        assert times_called() == expected
    (library,) = (tmp_path / "gradcal").glob("filter-*.so")
    library.write_bytes(b"")
    assert told(tmp_path, CXX=str(compiler))[0]
    assert times_called() == 2
    assert [path.name for path in (tmp_path / "gradcal").iterdir()] == [library.name]


def test_without_a_compiler_jax_does_it_and_a_compiler_that_fails_is_named(tmp_path):
    wanted = float(gram(*system(2, 5, 61))[1, 2])
    for environment, complaint in (
        ({"GRADCAL_NATIVE": "0"}, None),
        ({"PATH": str(tmp_path)}, None),
        ({"CXX": "false"}, "RuntimeWarning: the filter could not be compiled"),
    ):
        has, number, complained = told(tmp_path, **environment)
        assert not has, environment
        assert number == pytest.approx(wanted, rel=1e-12)
        assert complaint in complained if complaint else "Warning" not in complained
    assert not list(tmp_path.glob("gradcal/*"))


@pytest.mark.evidence
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("states", [1, 2, 3, 7, 9, 16])
def test_no_number_outside_its_array_is_touched(states, real, tmp_path):
    """The code itself, under the compiler's address and undefined-behaviour sanitisers."""
    here, program = Path(__file__).parent, tmp_path / "every_size"
    command = find_compiler()
    assert command is not None
    folders = [f"-I{jax.ffi.include_dir()}", f"-I{Path(native.__file__).parent}"]
    sanitise = ["-O1", "-w", "-march=native", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command = [*command, "-std=gnu++17", *sanitise, f"-DSTATES={states}", f"-DREAL={real}", *folders]
    subprocess.run([*command, str(here / "every_size.cc"), "-o", str(program)], check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "all sizes\n"), done.stderr[-2000:]
