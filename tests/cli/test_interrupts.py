"""Ctrl-C ends a command with 130 and one sentence, wherever it arrives."""

import gc
import signal

import jax  # noqa: F401  (its callback on garbage collection is what is tested)
import pytest

from gradcal_jax.cli import precision


@pytest.fixture
def _handler():
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    precision.use_float64()
    yield
    signal.signal(signal.SIGINT, before)


def _xla_gc_callback(*_):
    """As JAX's own, with the interrupt arriving in it."""
    gc.callbacks.remove(_xla_gc_callback)
    signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures("_handler")
def test_an_interrupt_in_garbage_collection_arrives_a_moment_later():
    gc.callbacks.append(_xla_gc_callback)
    gc.collect()
    with pytest.raises(KeyboardInterrupt):
        for _ in range(10**9):
            pass


@pytest.mark.usefixtures("_handler")
def test_an_interrupt_anywhere_else_arrives_at_once():
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
