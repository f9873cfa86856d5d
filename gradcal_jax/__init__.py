"""Calibration plans for gyros and accelerometers, designed by gradient descent through the predicted covariance.

The names below are the public API, in the order in which data flow. They load on first use (PEP 562): importing the
package, or its hardware and file rooms, never imports JAX.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME_OF_NAME: dict[str, str] = {}

__all__ = list(_HOME_OF_NAME)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF_NAME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
