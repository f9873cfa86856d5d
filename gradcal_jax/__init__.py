"""Calibration plans for gyros and accelerometers, designed by gradient descent through the predicted covariance.

The public API is the list of names in `__init__.pyi`; each command of `gradcal` is the function of the same name. They
load on first use (PEP 562): importing the package, or its hardware and file rooms, never imports JAX. The library does
not change JAX's global configuration; functions that report a covariance require
`jax.config.update("jax_enable_x64", True)` first.

`gradcal_jax.plots` draws their results. `logging.getLogger("gradcal_jax")` tells of searches, runs and logs that are
read.

Quantities are SI (°C for temperatures) unless the name ends in another unit; reports are in ppm and deg/h.
"""

import ast
import importlib
import logging
from pathlib import Path
from typing import Any

__version__ = "1.0.0"

# What the package logs goes to handlers of the program that uses it, or nowhere.
logging.getLogger(__name__).addHandler(logging.NullHandler())

# The stub for type checkers is the list of the public names and of their homes.
_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
_HOME_OF_NAME: dict[str, str] = {
    alias.name: (node.module or "").removeprefix("gradcal_jax.")
    for node in _STUB
    if isinstance(node, ast.ImportFrom) and node.module != "typing"
    for alias in node.names
}

__all__ = list(_HOME_OF_NAME)


def __getattr__(name: str) -> Any:
    if name == "plots":
        return importlib.import_module("gradcal_jax.plots")
    if name == "presets":
        return importlib.import_module("gradcal_jax.spec.presets")
    if name not in _HOME_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF_NAME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "plots"])
