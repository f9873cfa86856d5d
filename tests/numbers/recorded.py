"""What is recorded of a case, computed by the code at hand; `record.py` writes it, `test_numbers.py` compares it."""

import gzip
import json
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from gradcal_jax.calibration.correction import apply
from gradcal_jax.calibration.exports import export
from gradcal_jax.calibration.file import parse_calibration
from gradcal_jax.estimation.log_flow import estimate as estimate_log
from gradcal_jax.information.prediction import counted_shares, predict
from gradcal_jax.information.sensitivity import sensitivity
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import read_log
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.spec import spec_of

HERE = Path(__file__).resolve().parent
Tables = dict[str, Any]
TARGETS = ("ardupilot", "px4", "kalibr", "matrices", "c-header", "csv")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?=f?(?![\w.]))")
STATISTICS = ("mean of max", "max", "mean", "rms")


def read(kind: str) -> dict[str, Any]:
    """The data file of a kind."""
    return json.loads((HERE / f"{kind}.json").read_text(encoding="utf-8"))


def prediction(tables: Tables) -> Tables:
    """Statistics of every requirement, and the standard deviation of every parameter."""
    answer = predict(spec_of(tables))
    return {"requirements": rows(answer), "parameters": {f"{p.name} / {p.axis}": p.std for p in answer.parameters}}


JUDGED = ("verdict", "with_typical", "another_run", "worst")


def judgement(tables: Tables) -> Tables:
    """What verdicts count on a spec of one axis: by requirement the judged values, and the share of every
    error; typical figures of omitted terms."""
    spec = spec_of(tables)
    answer, shares = predict(spec), counted_shares(spec)
    found: Tables = {}
    for row in answer.requirements:
        one = {name: value for name in JUDGED if (value := getattr(row, name)) is not None}
        if row.name in shares:
            one["shares"] = {name: share for name, share in shares[row.name].items() if abs(share) > 1e-9}
        found[row.name] = one
    return {"requirements": found, "omitted": sorted(t.typical for t in answer.omitted)}


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
        of = found.setdefault(row.requirement, {})
        of[row.figure] = row.percent
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
    """Every export as its numbers with its losses; and the measurements corrected."""
    of = parse_calibration(tomlkit.dumps(tables))
    exports = {target: exported(of, target) for target in TARGETS}
    log = apply(of, measurements()).log
    corrected: Tables = {"rate": log.rate_rad_per_s[0].tolist()}
    if log.specific_force_m_per_s2 is not None:
        corrected["force"] = log.specific_force_m_per_s2[0].tolist()
    return {"exports": exports, "corrected": corrected}


def exported(of: Any, target: str) -> Tables:
    """Numbers and losses of one export, or the sentence with which it is refused."""
    options: Tables = {"temperature_c": 25.0 if target in ("kalibr", "matrices") else None}
    options |= {"device_id": 4321} if target == "px4" else {}
    try:
        done = export(of, target, **options)
    except ValueError as error:
        return {"refused": str(error)}
    return {"numbers": numbers(done.text, target), "losses": [[*loss] for loss in done.losses]}


def numbers(text: str, target: str) -> list[list[float]]:
    """The numbers of every line of an export that has any, without those of comments and words."""
    found = []
    for line in text.splitlines():
        if line.lstrip().startswith(("#", "/*", "*")):
            continue
        if target == "csv":
            line = ",".join(line.split(",")[4:6])
        row = [float(number) for number in NUMBER.findall(line)]
        if row:
            found.append(row)
    return found


def estimate(name: str, tables: Tables) -> Tables:
    """Coefficients, their standard deviations and the fit's χ² of a log beside this file, in the calibration's SI."""
    spec, logs = spec_of(tables), [unpacked(path) for path in sorted((HERE / "logs").glob(f"{name}, *.nc.gz"))]
    found = map(tables_of, estimate_log(spec, logs).calibrations)
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
