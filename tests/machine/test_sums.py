"""The sums in machine code are XLA's: values, first and second derivatives, batches, precisions."""

import subprocess
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre as np_legendre

from gradcal_jax.arrays import running_sum
from gradcal_jax.machine import compiler, legendre_sums, sums

pytestmark = pytest.mark.skipif(compiler() is None, reason="this machine has no C++ compiler")

# Pieces, nodes, polynomials of each variable: panels that are not full, full, and more than one; constants; the most.
SIZES = [(7, 15, 6, 6), (5, 8, 4, 4), (3, 2, 4, 1), (1, 1, 1, 1), (2, 33, 1, 5), (2, 17, 16, 16)]


def nodes(k: int, q: int, dtype=np.float64) -> list[jax.Array]:
    rng = np.random.default_rng([k, q])
    return [jnp.asarray(rng.uniform(-1.2, 1.2, (k, q)), dtype) for _ in range(3)]


def close(found, wanted, tolerance=1e-12):
    for f, w in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert f.dtype == w.dtype
        np.testing.assert_allclose(f, w, rtol=0.0, atol=tolerance * max(1.0, float(jnp.max(jnp.abs(w)))))


def value(function, weight, *at):
    return jnp.sum(weight * function(*at)) ** 2


@pytest.fixture
def by_xla(monkeypatch):
    def call(function, *arguments):
        with monkeypatch.context() as patch:
            patch.setenv("GRADCAL_NATIVE", "0")
            return jax.jit(lambda *a: function(*a))(*arguments)

    return call


@pytest.mark.parametrize("size", SIZES)
def test_products_of_polynomials(size, by_xla):
    k, q, first, second = size
    x, y, weight = nodes(k, q)
    found = jax.jit(partial(legendre_sums, first=first, second=second))(x, y, weight)
    of_x, of_y = (np_legendre.legvander(np.asarray(v), n - 1) for v, n in ((x, first), (y, second)))
    np.testing.assert_allclose(found, np.einsum("kq,kqa,kqb->kab", weight, of_x, of_y), rtol=0.0, atol=1e-11)
    given = jnp.asarray(np.random.default_rng(1).standard_normal((k, first, second)))

    def gradient(*at):
        return jax.grad(partial(value, partial(legendre_sums, first=first, second=second), given), argnums=(0, 1, 2))(
            *at
        )

    close(jax.jit(gradient)(x, y, weight), by_xla(gradient, x, y, weight))
    if k * q < 110:
        second_of = jax.jacfwd(gradient, argnums=(0, 1, 2))
        close(jax.jit(second_of)(x, y, weight), by_xla(second_of, x, y, weight))


def test_many_problems_at_once(by_xla):
    x, y, weight = (jnp.stack([v, 0.5 * v, -v]) for v in nodes(5, 13))

    def each(x, y, weight):
        one = lambda x, y, w: jax.grad(lambda w: jnp.sum(jnp.sin(legendre_sums(x, y, w, 4, 6))))(w)  # noqa: E731
        return jax.vmap(one, in_axes=(0, None, 0))(x, y[0], weight)

    close(jax.jit(each)(x, y, weight), by_xla(each, x, y, weight))


@pytest.mark.parametrize("shape", [(200,), (65, 36), (64, 1), (300, 4, 3), (63, 5), (100, 0)])
def test_running_sums(shape):
    values = np.random.default_rng(2).standard_normal(shape)
    wanted = np.cumsum(values, axis=0)
    np.testing.assert_allclose(jax.jit(running_sum)(jnp.asarray(values)), wanted, rtol=0.0, atol=1e-12)
    weight = np.random.default_rng(3).standard_normal(shape)
    back = jax.jit(jax.grad(lambda v: jnp.sum(weight * running_sum(v))))(jnp.asarray(values))
    np.testing.assert_allclose(back, np.cumsum(weight[::-1], axis=0)[::-1], rtol=0.0, atol=1e-12)
    many = jax.vmap(running_sum, in_axes=1, out_axes=1)(jnp.asarray(np.stack([values, 2.0 * values], axis=1)))
    np.testing.assert_allclose(many[:, 1], 2.0 * wanted, rtol=0.0, atol=1e-12)
    doubled = jax.jvp(running_sum, (jnp.asarray(values),), (jnp.asarray(2.0 * values),))[1]
    np.testing.assert_allclose(doubled, 2.0 * wanted, rtol=0.0, atol=1e-12)


def test_single_precision():
    found = legendre_sums(*nodes(4, 13, np.float32), 4, 6)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(
        found, legendre_sums(*(v.astype(float) for v in nodes(4, 13, np.float32)), 4, 6), atol=1e-4
    )


def test_programs_for_a_cpu_call_it_and_others_do_not():
    def text(platform: str) -> str:
        traced = jax.jit(lambda *a: running_sum(legendre_sums(*a, 4, 4))).trace(*nodes(80, 13))
        return traced.lower(lowering_platforms=(platform,)).as_text()

    assert sums._code(*nodes(1, 1)) is not None
    assert text("cpu").count("custom_call @gradcal") == 2
    assert "gradcal" not in text("cuda")


@pytest.mark.evidence
@pytest.mark.parametrize("real", ["double", "float"])
def test_no_number_outside_its_array_is_summed(real, tmp_path):
    """The code itself, under the compiler's address and undefined-behaviour sanitisers."""
    program, command = tmp_path / "every_sum", compiler()
    assert command is not None
    folders = [f"-I{jax.ffi.include_dir()}", f"-I{Path(sums.__file__).parent}"]
    sanitise = ["-O1", "-w", "-march=native", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    source = str(Path(__file__).with_name("every_sum.cc"))
    subprocess.run(
        [*command, "-std=gnu++17", *sanitise, f"-DREAL={real}", *folders, source, "-o", str(program)], check=True
    )
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "all sizes\n"), done.stderr[-2000:]
