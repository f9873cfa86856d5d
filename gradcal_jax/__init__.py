"""Calibration plans for gyros and accelerometers, designed by gradient descent through the predicted covariance.

The names below are the public API, in the order of the data flow; each command of `gradcal` is the function of the same
name. They load on first use (PEP 562): importing the package, or its hardware and file rooms, never imports JAX. The
library does not change JAX's global configuration; functions that report a covariance require
`jax.config.update("jax_enable_x64", True)` first.

`gradcal_jax.plots` draws their results. `logging.getLogger("gradcal_jax")` tells of searches, runs and logs that are
read.

Quantities are SI (°C for temperatures) unless the name ends in another unit; reports are in ppm and deg/h.
"""

import importlib
import logging
import warnings
from typing import Any

__version__ = "0.1.0"

# What the package logs goes to handlers of the program that uses it, or nowhere.
logging.getLogger(__name__).addHandler(logging.NullHandler())

_HOME_OF_NAME: dict[str, str] = {
    # what people write: specs, presets, rigs, and the schemas of all files
    "Spec": "files",
    "SpecError": "files",
    "changed": "files",
    "parse_spec": "files",
    "presets": "files",
    "read_rig": "files.rig",
    "read_spec": "files",
    "schema": "files",
    "write_toml": "files",
    # prediction
    "check": "api.flow",
    "predict": "api",
    "timeline": "api",
    "monte_carlo": "api",
    # design
    "optimise": "api.flow",
    "limit": "api.flow",
    "frontier": "api.flow",
    "sensitivity": "api.sensitivity",
    "differentiable": "api.differentiable",
    "recipe": "api",
    "replan": "api.replan",
    "read_recipe": "files.recipe",
    # many at once
    "read_sweep": "files.sweep",
    "sweep": "jobs.sweep",
    "read_dataset": "jobs.dataset",
    # runs and logs
    "run": "hardware.execute",
    "resume": "hardware.execute",
    "log": "decoding.run_log",
    "Log": "files.log",
    "read_log": "files.log_file",
    "write_log": "files.log_file",
    "import_log": "files.importers",
    "log_from": "files.log_from",
    # identification
    "instability": "api.log_flow",
    "allan": "api.log_flow",
    "fit_thermal_bias": "identify.thermal",
    "limiting_function": "identify.limiting_function",
    "limiting_function_of_mean": "identify.limiting_function",
    # calibrations
    "estimate": "api.log_flow",
    "Calibration": "files.calibration",
    "read_calibration": "files.calibration",
    "write_calibration": "files.calibration",
    "apply": "files.calibration.correction",
    "validate": "api.validation",
    "export": "files.calibration.exports",
    "lot": "api.lot",
    "report": "pages.report",
    "estimate_by_hand": "api.hand_estimate",
    # the core alone: error model, plans, covariance
    "SensorModel": "model",
    "gradient_plan": "trajectory",
    "standard_plan": "trajectory",
    "programme": "trajectory",
    "rest": "trajectory",
    "turn": "trajectory",
    "posterior": "information",
    "residual": "information",
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
