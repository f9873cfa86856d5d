"""How much a first `optimise` compiles, from the command line in a process of its own."""

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest
from search_problem import SPEC

_RUN = """
import jax, sys
from gradcal_jax.cli import main
jax.config.update("jax_log_compiles", True)
sys.exit(main(sys.argv[1:]))
"""


def compiled(folder: Path, name: str, spec: str) -> list[str]:
    """The names of the programs that `optimise` compiles, JAX's own cache of them being in `folder`."""
    path = folder / f"{name}.toml"
    path.write_text(spec, encoding="utf-8")
    arguments = ["optimise", str(path), "-o", str(folder / f"{name}.recipe.toml"), "--steps", "20"]
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"XDG_CACHE_HOME": str(folder)},
        timeout=300,
    )
    assert done.returncode in (0, 1), done.stderr[-2000:]
    return re.findall(r"Finished XLA compilation of (\S+)", done.stderr)


@pytest.mark.long
def test_a_first_search_compiles_its_objective_and_nothing_else(tmp_path):
    programs = compiled(tmp_path, "first", SPEC)
    # What prepares the descent takes milliseconds each.
    assert programs.count("jit(value_and_slope)") == 1
    assert len(programs) <= 20


KEPT = """
import resource, threading
from gradcal_jax.cli.precision import use_float64
use_float64()
import numpy as np

def arrays():
    for _ in range(20):
        [np.ones(4_000_000) for _ in range(4)]

faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(2):
    before = faults()
    thread = threading.Thread(target=arrays)
    thread.start()
    thread.join()
print(faults() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only GNU's C library can be told to keep memory")
def test_threads_keep_the_memory_that_they_freed():
    """Searches run in threads, whose freed arrays went back to the system: half of the time of a long search."""
    done = subprocess.run([sys.executable, "-c", KEPT], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 200
