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
import multiprocessing
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


def prediction(name_and_tables: tuple[str, dict]) -> tuple[str, dict]:
    """A case's record."""
    name, tables = name_and_tables
    return name, {"tables": tables, "changes": [], **recorded.prediction(tables)}


def elasticities(name_and_tables: tuple[str, dict]) -> tuple[str, dict | None]:
    """None where `sensitivity` refuses."""
    name, tables = name_and_tables
    with contextlib.suppress(ValueError):
        return name, recorded.elasticities(tables)
    return name, None


def unit(name_and_tables: tuple[str, dict]) -> tuple[str, dict]:
    name, tables = name_and_tables
    return name, {"tables": tables, **recorded.prediction(tables)}


def calibration(name_and_tables: tuple[str, dict]) -> tuple[str, dict]:
    name, tables = name_and_tables
    return name, {"tables": tables, **recorded.calibration(tables)}


def estimate(name_and_tables: tuple[str, dict]) -> tuple[str, dict]:
    name, tables = name_and_tables
    return name, {"tables": tables, **recorded.estimate(name, tables)}


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


KINDS = {
    "predictions": prediction,
    "elasticities": elasticities,
    "units": unit,
    "calibrations": calibration,
    "estimates": estimate,
    "axis_estimates": estimate,
}


def main(kind: str, *only: str) -> None:
    if kind == "all":
        for each in KINDS:
            main(each)
        return None
    path, every = HERE / f"{kind}.json", inputs(kind)
    before = recorded.read(kind) if path.exists() else {}
    records = dict(before) if only else {}
    wanted = {name: tables for name, tables in every.items() if not only or name in only}
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=8) as pool:
        for number, (name, made) in enumerate(pool.imap(KINDS[kind], wanted.items())):
            if made is not None:
                records[name] = made
                moved = difference(made, before[name]) if name in before else None
                print(f"{kind} {number + 1}/{len(wanted)} {name}: {made.get('changes', '')} {moved}", flush=True)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(made, ensure_ascii=False)}" for name, made in records.items())
    path.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
    return None


if __name__ == "__main__":
    main(*sys.argv[1:])
