"""gradcal_jax whose machine code has vectors of 32 bytes, as a processor with no wider ones gets it."""

import os

from peers import ours
from peers.problem import Problem


def build(problem: Problem) -> dict:
    os.environ["CXX"] = f"{os.environ.get('CXX', 'c++')} -mno-avx512f"
    return ours.build(problem)
