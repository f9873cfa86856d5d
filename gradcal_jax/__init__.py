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
import warnings
from pathlib import Path
from typing import Any

__version__ = "0.1.0"

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

# For one release: names of the time when an axis and an IMU had specs and calibrations of their own.
_OLD_NAMES: dict[str, str] = {
    "UnitSpec": "Spec",
    "read_unit_spec": "read_spec",
    "parse_unit_spec": "parse_spec",
    "estimate_units": "estimate",
    "UnitCalibration": "Calibration",
    "read_any_calibration": "read_calibration",
    "write_unit_calibration": "write_calibration",
    "apply_unit": "apply",
    "export_unit": "export",
}


# For one release: what takes the place of names that are gone.
_GONE: dict[str, str] = {
    "compare": "predict(spec, limits=True) of each spec",
    "recipes": "sweep, with write_recipes of gradcal_jax.jobs.recipes_of_sweep",
    "read_catalogue": "read_sweep, whose axes take sections of other specs",
    "unobservable": "check",
    "show": "print(recipe)",
    "tables_of": "gradcal_jax.files.tables_of",
    "parse_column_map": "import_log, which takes the map as text or the name of its file",
}


def __getattr__(name: str) -> Any:
    if name in _OLD_NAMES:
        sentence = f"gradcal_jax.{name} is now gradcal_jax.{_OLD_NAMES[name]}; the next release removes the old name"
        warnings.warn(sentence, DeprecationWarning, stacklevel=2)
        return __getattr__(_OLD_NAMES[name])
    if name == "plots":
        return importlib.import_module("gradcal_jax.plots")
    if name not in _HOME_OF_NAME:
        hint = f": in its place {_GONE[name]}" if name in _GONE else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF_NAME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "plots"])
