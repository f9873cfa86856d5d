"""Records what the code at hand predicts, into the data files beside this script: numbers that must be kept.

    python tests/numbers/record.py predictions     # statistics of every requirement, std of every parameter
    python tests/numbers/record.py elasticities    # of `sensitivity`: exact derivatives of the same numbers
    python tests/numbers/record.py predictions "any 1"     # of these cases alone; the others stay as recorded

Cases are random specs, every preset, and the specs of experiments/. A case whose number is known to be wrong says in
`changes` why; it is recorded all the same, so that a later difference can be shown. Floats are written in full.
"""

import json
import multiprocessing
import os
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np

from gradcal_jax.api import assemble, predict
from gradcal_jax.api.sensitivity import sensitivity
from gradcal_jax.files import Spec, presets, spec_of
from gradcal_jax.files.schedule import StandardSchedule

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE.parent))

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
    spec = spec_of(tables)
    answer = predict(spec, limits=False)
    return name, {
        "tables": tables,
        "changes": changing(spec),
        "requirements": {
            f"{r.name} / {r.axis}": {"mean of max": r.mean_of_max, "max": r.max, "mean": r.mean, "rms": r.rms}
            for r in answer.requirements
        },
        "parameters": {f"{p.name} / {p.axis}": p.std for p in answer.parameters},
    }


def elasticities(name_and_tables: tuple[str, dict]) -> tuple[str, dict | None]:
    """Per cent of each requirement's residual for one per cent of each figure; None where `sensitivity` refuses."""
    name, tables = name_and_tables
    try:
        rows = sensitivity(spec_of(tables)).rows
    except ValueError:
        return name, None
    found: dict[str, dict[str, float]] = {}
    for row in rows:
        found.setdefault(row.requirement, {})[row.figure] = row.percent
    return name, found


def main(kind: str, *only: str) -> None:
    record = {"predictions": prediction, "elasticities": elasticities}[kind]
    every, path = cases(), HERE / f"{kind}.json"
    if only or kind == "elasticities":
        # As they were drawn then, whatever the generator draws today.
        recorded = json.loads((HERE / "predictions.json").read_text(encoding="utf-8"))
        every = {name: made["tables"] for name, made in recorded.items()}
    if kind == "elasticities":
        # Of every third random spec: their program is the larger by far.
        every = {name: t for k, (name, t) in enumerate(every.items()) if k >= 60 or k % 3 == 0}
    records = json.loads(path.read_text(encoding="utf-8")) if only else {}
    wanted = {name: tables for name, tables in every.items() if not only or name in only}
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=8) as pool:
        for name, made in pool.imap(record, wanted.items()):
            if made is not None:
                records[name] = made
            print(f"{len(records)}/{len(every)} {name}: {made.get('changes', '') if made else None}", flush=True)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(made, ensure_ascii=False)}" for name, made in records.items())
    path.write_text("{\n" + lines + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
