"""Records what the code at hand predicts, into the data files beside this script: numbers that must be kept.

    python tests/numbers/record.py all             # everything below, one after the other
    python tests/numbers/record.py predictions     # statistics of every requirement, std of every parameter
    python tests/numbers/record.py elasticities    # of `sensitivity`: exact derivatives of the same numbers
    python tests/numbers/record.py units           # as predictions, of every preset of a unit
    python tests/numbers/record.py calibrations    # every export, and `apply` to the same measurements
    python tests/numbers/record.py estimates       # of the logs beside this file, of an axis by its own estimator then
    python tests/numbers/record.py axis_estimates  # of those of an axis, by the estimator of all channels
    python tests/numbers/record.py logs            # those logs themselves, simulated with fixed seeds: not in "all"
    python tests/numbers/record.py predictions "any 1"     # of these cases alone; the others stay as recorded

Cases are random specs, every preset, and the specs of experiments/. A case whose number is known to be wrong says in
`changes` why; it is recorded all the same, so that a later difference can be shown. Floats are written in full. What is
recorded has its inputs with it: a case is drawn once, and recorded anew as it was drawn. Every number that a change
moves is printed with its largest relative difference.
"""

import contextlib
import json
import multiprocessing
import os
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np

from gradcal_jax.model.build import assemble
from gradcal_jax.spec import presets
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec import Spec, spec_of

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(HERE.parent), *(str(HERE.parent / room) for room in ("files", "unit", "estimation"))]

import draw  # noqa: E402
import recorded  # noqa: E402
from random_specs import random_spec  # noqa: E402

# Every case compiles a program of its own that runs once: what XLA does not optimise costs nothing here.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_enable_x64", True)

FAMILIES = {
    "static gradient": ({}, 6),
    "static standard": ({"processes": False}, 4),
    "dynamic gradient": ({"axes": 1}, 11),
    "dynamic standard": ({"processes": False}, 7),
    "tactical": ({"axes": 1}, 12),
    "consumer": ({"axes": 1}, 8),
    "hand": ({"axes": 1}, 5),
}
"""How many random specs of each kind, restricted to what is likely to be right; besides these a few of all else."""
SPECS = (
    "experiments/designs/headline.toml",
    "experiments/paper/dynamic_gradient.toml",
    "experiments/paper/dynamic_standard.toml",
    "experiments/paper/static_gradient.toml",
    "experiments/paper/static_standard.toml",
)
RECIPE = "experiments/recipes/headline.toml"


def cases() -> dict[str, dict]:
    """TOML tables of every case, by name."""
    found: dict[str, dict] = {}
    for family, (restrict, count) in FAMILIES.items():
        for seed in range(count):
            rng = np.random.default_rng([len(found), seed])
            found[f"{family} {seed}"] = random_spec(rng, family=family, rests_read_at_end=False, **restrict)
    for seed, restrict in enumerate(
        (
            {"family": "tactical", "axes": 2},
            {"family": "dynamic gradient", "axes": 3},
            {"family": "hand", "axes": 2},
            {"family": "dynamic gradient", "rests_read_at_end": True},
            {"family": "dynamic standard", "processes": True},
            {"family": "dynamic standard", "processes": True, "estimator": "least squares"},
            {"family": "static standard", "processes": True},
        )
    ):
        found[f"any {seed}"] = random_spec(np.random.default_rng([1000, seed]), **restrict)
    found |= {f"preset {name}": tomllib.loads(presets.text(name)) for name in presets.names()}
    found |= {path: tomllib.loads((ROOT / path).read_text()) for path in SPECS}
    found[RECIPE] = tomllib.loads((ROOT / RECIPE).read_text())["spec"]
    return found


def changing(spec: Spec) -> list[str]:
    """Why the number of a spec is known to be wrong as the code stands; empty where it is right."""
    if isinstance(spec.schedule, StandardSchedule) or (cycle := spec.gradient_schedule.cycle) is None:
        return []
    read_in_turn = cycle.other_read_every is not None and len(assemble(spec).channels) > 1
    return ["several axes, read while others turn"] if read_in_turn else []


def prediction(name_and_tables: tuple[str, dict]) -> tuple[str, dict]:
    """A case's record."""
    name, tables = name_and_tables
    return name, {"tables": tables, "changes": changing(spec_of(tables)), **recorded.prediction(tables)}


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


def drawn(kind: str) -> dict[str, dict]:
    """Inputs by case: of what is recorded already, as they were drawn then."""
    if kind == "elasticities":
        # Of every third random spec: their program is the larger by far.
        every = {name: of["tables"] for name, of in recorded.read("predictions").items()}
        return {name: t for k, (name, t) in enumerate(every.items()) if k >= 60 or k % 3 == 0}
    if (HERE / f"{kind}.json").exists():
        return {name: of["tables"] for name, of in recorded.read(kind).items()}
    if kind == "axis_estimates":
        every = {name: of["tables"] for name, of in recorded.read("estimates").items()}
        return {name: tables for name, tables in every.items() if "quantity" in tables["sensor"]}
    if kind == "units":
        return {name: tomllib.loads(presets.text(name)) for name in presets.names()}
    if kind == "calibrations":
        return draw.calibrations()
    if kind == "estimates":
        return json.loads((HERE / "logs" / "specs.json").read_text(encoding="utf-8"))
    return cases()


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
    if kind == "logs":
        return draw.logs()
    if kind == "all":
        for each in KINDS:
            main(each)
        return None
    path, every = HERE / f"{kind}.json", drawn(kind)
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
