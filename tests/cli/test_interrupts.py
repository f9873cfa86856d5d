"""Ctrl-C arrives, wherever in JAX it finds the program: whatever is raised in JAX's garbage collection is lost."""

import subprocess
import sys

import pytest

# An interrupt in a function of the name that JAX's callback has, as it comes from the terminal: raised, printed, lost.
IN_COLLECTION = """
def _xla_gc_callback(*_):
    gc.callbacks.remove(_xla_gc_callback)
    signal.raise_signal(signal.SIGINT)
gc.callbacks.append(_xla_gc_callback)
gc.collect()
"""
# Who starts the tests in the background of a shell has them ignore interrupts: undone first.
PROGRAM = """
import gc, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from gradcal_jax.cli import precision
{setup}
try:
    {interrupt}
    time.sleep({wait})
except KeyboardInterrupt:
    sys.exit(130)
"""


def outcome(setup: str, interrupt: str, wait: float) -> tuple[int, str]:
    program = PROGRAM.format(setup=setup, interrupt=interrupt.strip().replace("\n", "\n    "), wait=wait)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    return done.returncode, done.stderr


@pytest.mark.long
@pytest.mark.parametrize("interrupt", [IN_COLLECTION, "signal.raise_signal(signal.SIGINT)"])
def test_an_interrupt_arrives(interrupt):
    assert outcome("precision.use_float64()", interrupt, 30.0) == (130, "")
