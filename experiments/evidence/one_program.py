"""Processor time (s) of a prediction or of a step of an IMU's search, by the package on the path, this or an older one.

    PYTHONPATH=CHECKOUT python experiments/evidence/one_program.py predict|step SPEC [--zeros]

`--zeros`: what the spec omits is stated as zero, so that no typical figures count, as in packages that know of none.
In a step, the older package evaluates a plan, and this one a plan with its gradient in all numbers of the cycle.
"""

import argparse
import statistics
import time
from itertools import pairwise
from typing import Any

import jax

import gradcal_jax as gj

ZEROS: dict[str, Any] = {
    "accelerometer.turn_on_bias": "0 mg",
    "turn_on_bias": "0 deg/h",
    "temperature_offset": "0 K",
    "temperature_lag": "0 s",
    "rate_random_walk": "0 deg/h/sqrt(h)",
    "scale_factor_instability": [],
    "bias_temperature_gradient": "0 deg/h/(K/min)",
    "gravity_accuracy": "0 m/s^2",
    "scale_error": "0 ppm",
    "sample_clock_error": "0 ppm",
}


def read(path: str) -> Any:
    """A spec; the older package has a function of its own for IMUs."""
    of_imus = getattr(gj, "read_unit_spec", None) if "UnitSpec" in gj.__all__ else None
    if of_imus is None:
        return gj.read_spec(path)
    try:
        return gj.read_spec(path)
    except ValueError:
        return of_imus(path)


def stated(spec: Any) -> Any:
    """The spec with zeros for all that it omits."""
    for term in gj.predict(spec).omitted:
        spec = gj.changed(spec, {term.key: next(zero for end, zero in ZEROS.items() if term.key.endswith(end))})
    return spec


def prediction(spec: Any) -> float:
    """The median of fifteen, after two."""
    times = []
    for _ in range(17):
        begin = time.process_time()
        gj.predict(spec)
        times.append(time.process_time() - begin)
    return statistics.median(times[2:])


def step(spec: Any) -> float:
    """Of one evaluation in a search, after all is compiled."""
    try:
        from gradcal_jax.api.unit_optimise import optimise_unit
    except ImportError:
        from gradcal_jax.design.optimise import run_search

        # The last block of evaluations is the longest one.
        begin, count, longest = time.process_time(), 0, (0, 0.0)
        for event in run_search(spec, steps=300):
            now, number = time.process_time(), getattr(event, "evaluations", 0)
            longest = max(longest, (number - count, now - begin))
            begin, count = now, number
        return longest[1] / longest[0]
    times = [time.process_time()]
    times += [time.process_time() for _ in optimise_unit(spec, evaluations=50)]
    # (Two evaluations between two states of that search.)
    return statistics.median([b - a for a, b in pairwise(times[2:-1])]) / 2.0


def main() -> None:
    """Print the time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=["predict", "step"])
    parser.add_argument("spec")
    parser.add_argument("--zeros", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    spec = read(given.spec)
    spec = stated(spec) if given.zeros else spec
    print(f"{prediction(spec) if given.case == 'predict' else step(spec):.5f}")


if __name__ == "__main__":
    main()
