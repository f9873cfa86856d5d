"""Calibration files of version 1 in the form of version 2, before they are validated.

Version 1 had two forms, of a gyro's axes (`[[axis]]` with maps of its own) and of a whole IMU (`quantity = "unit"`,
with one range for all channels). Faults of an old file stay faults, which the validation reports.
"""

import copy
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

FORMAT: Final = "gradcal-calibration/2"
OLD_FORMAT: Final = "gradcal-calibration/1"
_GRADIENT: Final = "bias_temperature_gradient"
Tables = dict[str, Any]


def upgraded(document: Mapping[str, Any]) -> Tables:
    """The tables of a calibration in today's form; tables of other formats, and what is not understood, as they are."""
    if document.get("format") != OLD_FORMAT:
        return dict(document)
    tables = copy.deepcopy(dict(document)) | {"format": FORMAT}
    try:
        return _FORMS[tables.pop("quantity")](tables)
    except (AttributeError, KeyError, TypeError):
        return dict(document) | {"format": FORMAT}


def _from_unit(tables: Tables) -> Tables:
    shared = {key: tables.pop(key) for key in ("valid_temperature", "valid_rate", "thermal_lag") if key in tables}
    return tables | {"channel": [channel | shared for channel in tables["channel"]]}


def _from_axes(tables: Tables) -> Tables:
    whole: dict[str, list[Any]] = {"fit": [], "contradicted": [], "unobservable": [], "unseen": []}
    channels: list[Tables] = []
    names: list[str] = []
    blocks: list[Any] = []
    for axis in tables.pop("axis"):
        label = axis.pop("name")
        name = f"gyro_{label}"
        own: Tables = {key: axis.pop(key, ()) for key in whole}
        whole["fit"] += [test | {"name": f"{name}: {test['name']}"} for test in own["fit"]]
        whole["unseen"] += [
            error | {"coefficients": {f"{name}.{n}": v for n, v in error["coefficients"].items()}}
            for error in own["unseen"]
        ]
        for key in ("contradicted", "unobservable"):
            whole[key] += [f"{name}: {words}" for words in own[key]]
        if (covariance := axis.pop("covariance", None)) is not None:
            names += [f"{name}.{coefficient}" for coefficient in covariance["names"]]
            blocks.append(covariance["matrix"])
        channels.append({"kind": "gyro", "axis": label, "term": list(_terms(axis, f"rate {label}")), **axis})
    known: Tables = {"covariance": {"names": names, "matrix": _diagonal(blocks)}} if blocks else {}
    return tables | {"channel": channels} | known | {key: rows for key, rows in whole.items() if rows}


_FORMS: Final[Mapping[Any, Callable[[Tables], Tables]]] = {"unit": _from_unit, "gyro": _from_axes}


def _terms(axis: Tables, rate: str) -> Iterator[Tables]:
    for name, unit, signals in (("bias", "rad/s", []), ("scale_factor", "1", [rate])):
        if (part := axis.pop(name, None)) is not None:
            values = part["coefficients"]
            ordered = {key: values[key] for key in sorted(values, key=function_of)}
            yield {"name": name, "unit": unit, "signals": signals, **part, "coefficients": ordered}
    if (value := axis.pop(_GRADIENT, None)) is not None:
        values = {_GRADIENT: value}
        yield {"name": _GRADIENT, "unit": "rad/K", "signals": ["temperature rate"], "coefficients": values}


def function_of(name: str) -> list[int]:
    """The functions of temperature and of rate that a coefficient multiplies: [3] for a3, [2, 1] for b12, [11, 2] for
    b2_11, [4, 0] for b_bin0_spline4."""
    digits = re.findall(r"\d" if re.fullmatch(r"b\d\d", name) else r"\d+", name)
    return [int(digit) for digit in reversed(digits)]


def _diagonal(blocks: list[Any]) -> list[list[Any]]:
    """One matrix of blocks on a diagonal."""
    size = sum(len(block) for block in blocks)
    rows: list[list[Any]] = []
    for block in blocks:
        before = len(rows)
        rows += [[*[0.0] * before, *row, *[0.0] * (size - before - len(block))] for row in block]
    return rows
