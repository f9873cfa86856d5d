"""Records what the code at hand predicts, into the data files beside this script: numbers that must be kept.

    python tests/numbers/record.py all             # everything below, one after the other
    python tests/numbers/record.py predictions     # statistics of every requirement, std of every parameter
    python tests/numbers/record.py elasticities    # of `sensitivity`: exact derivatives of the same numbers
    python tests/numbers/record.py units           # as predictions, of every preset of a unit
    python tests/numbers/record.py calibrations    # every export, and `apply` to the same measurements
    python tests/numbers/record.py predictions "any 1"     # of these cases alone; the others stay as recorded

Cases are random specs, presets, and specs of experiments, each with its inputs. Floats are written in full.
Every number that a change moves is printed with its largest relative difference.
"""

import contextlib
import json
import os
import sys
from pathlib import Path

import jax

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), *(str(HERE.parent / room) for room in ("files", "unit", "estimation"))]

import recorded  # noqa: E402

# Every case compiles a program of its own that runs once: what XLA does not optimise costs nothing here.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_enable_x64", True)


def record_of(kind: str, name: str, tables: dict) -> dict:
    """A case's record. Raises `ValueError` where `sensitivity` refuses."""
    if kind == "elasticities":
        return recorded.elasticities(tables)
    if kind == "calibrations":
        return {"tables": tables, **recorded.calibration(tables)}
    if kind in ("predictions", "units"):
        return {"tables": tables, **recorded.prediction(tables)}
    return {"tables": tables, **recorded.estimate(name, tables)}


def inputs(kind: str) -> dict[str, dict]:
    """Inputs by case, as they were recorded."""
    if kind == "elasticities":
        # Of every third random spec: their program is the larger by far.
        every = {name: of["tables"] for name, of in recorded.read("predictions").items()}
        return {name: t for k, (name, t) in enumerate(every.items()) if k >= 60 or k % 3 == 0}
    return {name: of["tables"] for name, of in recorded.read(kind).items()}


def difference(new: object, old: object) -> float:
    """The largest relative difference of the numbers of two records."""
    if isinstance(new, dict) and isinstance(old, dict):
        return max((difference(new[k], old.get(k)) for k in new if k != "tables"), default=0.0)
    if isinstance(new, list) and isinstance(old, list) and len(new) == len(old):
        return max((difference(a, b) for a, b in zip(new, old, strict=True)), default=0.0)
    if isinstance(new, float) and isinstance(old, float | int):
        return abs(new - old) / max(abs(old), 1e-300)
    return 0.0 if new == old else float("inf")


KINDS = ("predictions", "elasticities", "units", "calibrations", "estimates", "axis_estimates")


def main(kind: str, *only: str) -> None:
    if kind == "all":
        for each in KINDS:
            main(each)
        return None
    path, every = HERE / f"{kind}.json", inputs(kind)
    before = recorded.read(kind) if path.exists() else {}
    records = dict(before) if only else {}
    for name, tables in every.items():
        if only and name not in only:
            continue
        with contextlib.suppress(ValueError):
            records[name] = record_of(kind, name, tables)
            moved = difference(records[name], before[name]) if name in before else None
            print(f"{kind} {name}: {moved}", flush=True)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(made, ensure_ascii=False)}" for name, made in records.items())
    path.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
    return None


if __name__ == "__main__":
    main(*sys.argv[1:])
