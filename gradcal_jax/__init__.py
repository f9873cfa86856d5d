"""Calibration plans for gyros and accelerometers, designed by gradient descent through the predicted covariance.

The names below are the public API, in the order in which data flow. They load on first use (PEP 562): importing the
package, or its hardware and file rooms, never imports JAX.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME_OF_NAME: dict[str, str] = {
    # files
    "Spec": "files",
    "SpecError": "files",
    "changed": "files",
    "parse_spec": "files",
    "presets": "files",
    "read_spec": "files",
    "schema": "files",
    "tables_of": "files",
    "write_toml": "files",
    # error model and plans
    "GyroModel": "errormodel",
    "gradient_plan": "plans",
    "standard_plan": "plans",
    "rest": "plans",
    "turn": "plans",
    "programme": "plans",
    # prediction
    "posterior": "information",
    "residual": "information",
    "predict": "assemble",
    "monte_carlo": "assemble",
    "timeline": "assemble",
    "unobservable": "assemble",
    # identification
    "limiting_function": "identify.limiting_function",
    "limiting_function_of_mean": "identify.limiting_function",
}

__all__ = list(_HOME_OF_NAME)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF_NAME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
