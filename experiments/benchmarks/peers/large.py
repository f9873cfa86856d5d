"""600 000 readings × 64 parameters: Φ is never held as a whole, each tile makes its own rows."""

import resource
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.information.tiles import information_in_tiles
from peers.jax_tasks import log_det
from peers.ours import noise_steps
from peers.problem import make_problem

_ROWS = 4000


def _megabytes(what: str) -> float:
    """`VmRSS`, what the process holds now, or `VmHWM`, its most since it began, compiling included.

    `getrusage` is the second choice: on Linux its peak is inherited from the process that started this one.
    """
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith(what)) * 1024 / 1e6
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def _chain(what: str, count: int, parameters: int, rows: int):
    """A compiled function of a seed for the whole case, `count` readings in tiles of `rows`."""
    problem = make_problem(8, parameters)
    tiles = -(-count // rows)

    def times(index):
        # Jittered by a tenth of a second, in a way that needs no table.
        k = index.astype(float)
        return k + 0.1 * jnp.sin(1.7 * k)

    def tile(index, phase):
        index = index * rows + jnp.arange(rows)
        after = times(index + 1)
        u = (after / count)[:, None]
        cycles = 0.7 * jnp.arange(1, parameters + 1)[None, :]
        columns = (0.2 + u) * jnp.cos(2.0 * jnp.pi * cycles * u + phase[None, :])
        steps = noise_steps(problem, after - times(index))
        return steps._replace(used=index < count), columns

    def ours(phase):
        initial = noise_steps(problem, jnp.ones(1)).initial
        return information_in_tiles(lambda i: tile(i, phase), tiles, parameters, initial)[0]

    def floor(phase):
        def one(total, index):
            _, columns = tile(index, phase)
            return total + columns.T @ columns, None

        return jax.lax.scan(one, jnp.zeros((parameters, parameters)), jnp.arange(tiles))[0]

    return jax.jit({"ours": ours, "floor": floor}[what])


def stream(asked: dict) -> dict:
    """Seconds of three runs, and the peak of resident memory above what the process held after a tiny run."""
    parameters, count = asked["parameters"], asked["count"]
    phase = jnp.asarray(np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, parameters))
    jax.block_until_ready(_chain(asked["what"], 256, parameters, 64)(phase))
    before = _megabytes("VmRSS")
    run = _chain(asked["what"], count, parameters, min(_ROWS, count))
    information = jax.block_until_ready(run(phase))
    seconds = []
    for _ in range(3):
        begin = time.perf_counter()
        information = jax.block_until_ready(run(phase))
        seconds.append(time.perf_counter() - begin)
    return {
        "seconds": seconds,
        "megabytes": _megabytes("VmHWM") - before,
        "log det": float(log_det(information / jnp.max(information))),
    }
