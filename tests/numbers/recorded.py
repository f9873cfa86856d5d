"""What is recorded of a case, computed by the code at hand; `record.py` writes it, `test_numbers.py` compares it."""

import gzip
import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from gradcal_jax.api import predict
from gradcal_jax.api.estimate import estimate_sensors
from gradcal_jax.api.log_flow import estimate as estimate_axes
from gradcal_jax.api.sensitivity import sensitivity
from gradcal_jax.files import Spec, spec_of, tables_of
from gradcal_jax.files.calibration import parse_calibration
from gradcal_jax.files.calibration.correction import apply
from gradcal_jax.files.calibration.exports import export
from gradcal_jax.files.log import Log
from gradcal_jax.files.log_file import read_log
from gradcal_jax.files.spec import spec_of
from gradcal_jax.files.unit_spec import UnitSpec

HERE = Path(__file__).resolve().parent
Tables = dict[str, Any]
TARGETS = ("ardupilot", "px4", "kalibr", "matrices", "c-header", "csv")
STATISTICS = ("mean of max", "max", "mean", "rms")


def read(kind: str) -> dict[str, Any]:
    """The data file of a kind."""
    return json.loads((HERE / f"{kind}.json").read_text(encoding="utf-8"))


def any_spec(tables: Tables) -> UnitSpec:
    """A spec of an axis, or of a unit."""
    return spec_of(tables) if "quantity" in tables["sensor"] else spec_of(tables)


def prediction(tables: Tables) -> Tables:
    """Statistics of every requirement, and the standard deviation of every parameter."""
    answer = predict(any_spec(tables), limits=False)
    return {"requirements": rows(answer), "parameters": {f"{p.name} / {p.axis}": p.std for p in answer.parameters}}


def rows(answer: Any) -> Tables:
    """Statistics by requirement and axis."""
    return {
        f"{r.name} / {r.axis}": {name: getattr(r, name.replace(" ", "_")) for name in STATISTICS}
        for r in answer.requirements
    }


def elasticities(tables: Tables) -> Tables:
    """Per cent of each requirement's residual for one per cent of each figure. Raises `ValueError` where refused."""
    found: dict[str, dict[str, float]] = {}
    for row in sensitivity(spec_of(tables)).rows:
        found.setdefault(row.requirement, {})[row.figure] = row.percent
    return found


def measurements() -> Log:
    """What every recorded calibration is applied to: ten samples, some beyond the calibrations' ranges."""
    k = np.arange(10.0)
    rate = np.stack([np.radians(340.0) * np.sin(1.0 + i + 1.7 * k) for i in range(3)], axis=1)
    force = np.stack([9.8 * np.cos(0.3 + i + 2.3 * k) for i in range(3)], axis=1)
    temperature = 20.0 + 55.0 * np.sin(0.4 + 0.9 * k)
    return Log(
        time_s=20.0 * k,
        rate_rad_per_s=rate[None],
        units=("SN 1",),
        axes=("x", "y", "z"),
        temperature_c=temperature[None],
        specific_force_m_per_s2=force[None],
        force_axes=("x", "y", "z"),
    )


def calibration(tables: Tables) -> Tables:
    """Every export as the hash of its text, with losses and notes; and the measurements corrected."""
    of = parse_calibration(tomlkit.dumps(tables))
    exports = {target: exported(of, target) for target in TARGETS}
    log = apply(of, measurements()).log
    corrected: Tables = {"rate": log.rate_rad_per_s[0].tolist()}
    if log.specific_force_m_per_s2 is not None:
        corrected["force"] = log.specific_force_m_per_s2[0].tolist()
    return {"exports": exports, "corrected": corrected}


def exported(of: Any, target: str) -> Tables:
    """One export, or the sentence with which it is refused."""
    options: Tables = {"temperature_c": 25.0 if target in ("kalibr", "matrices") else None}
    options |= {"device_id": 4321} if target == "px4" else {}
    try:
        done = export(of, target, **options)
    except ValueError as error:
        return {"refused": str(error)}
    lines = done.text.splitlines()
    return {
        "sha256": hashlib.sha256(done.text.encode()).hexdigest(),
        "lines": len(lines),
        "losses": [[*loss] for loss in done.losses],
        "notes": list(done.notes),
    }


def estimate(name: str, tables: Tables) -> Tables:
    """Coefficients, their standard deviations and the fit's χ² of a log beside this file, in the calibration's SI."""
    spec, logs = any_spec(tables), [unpacked(path) for path in sorted((HERE / "logs").glob(f"{name}, *.nc.gz"))]
    if isinstance(spec, Spec):
        found = [tables_of(c) for c in estimate_axes(spec, logs[0]).calibrations]
    else:
        found = [tables_of(report.calibration) for report in estimate_sensors(spec, logs)]
    return {document["serial_number"]: result(document) for document in found}


def unpacked(path: Path) -> Log:
    """A log that was packed."""
    with tempfile.TemporaryDirectory() as scratch:
        Path(scratch, "log.nc").write_bytes(gzip.decompress(path.read_bytes()))
        return read_log(Path(scratch, "log.nc"))


def result(document: Tables) -> Tables:
    """Numbers of a calibration file."""
    values = {
        f"{channel['kind']}_{channel['axis']}.{k}": v
        for channel in document["channel"]
        for term in channel["term"]
        for k, v in term["coefficients"].items()
    }
    known = document["covariance"]
    stds = dict(zip(known["names"], np.sqrt(np.diag(np.array(known["matrix"]))).tolist(), strict=True))
    tests = {test["name"]: [test["statistic"], test["degrees"]] for test in document.get("fit", ())}
    return {"values": values, "std": stds, "tests": tests}
