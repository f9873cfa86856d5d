"""Is the result of `optimise` ever worse than the plan of the file? Every preset, seed by seed.

    python experiments/designs/presets.py                                      all: several hours of processor time
    python experiments/designs/presets.py --case tactical-mems --seed 1        one, to experiments/designs/presets
    python experiments/designs/presets.py --report                             presets.md of what is there

Some IMUs (three axes, several mountings or plateaus) take the better part of an hour; `--steps` ends each
search earlier. In the table, "all" stands for the number of steps that `optimise` takes by itself.
Of a preset without a [design] it is the one that `optimise` offers. Both values are of the plans as `predict` has them.
"""

import argparse
import json
import time
import tomllib
from pathlib import Path

from gradcal_jax.cli.precision import use_float64

use_float64()

import gradcal_jax as gj  # noqa: E402
from gradcal_jax.design.optimise import run_search  # noqa: E402
from gradcal_jax.design.searching import Optimised  # noqa: E402
from gradcal_jax.design.turn_plan import design_block  # noqa: E402

HERE = Path(__file__).parent
SEEDS = range(3)


def design(name: str) -> gj.Spec:
    """A preset with its [design], or with the one that `optimise` offers."""
    spec = gj.parse_spec(gj.presets.text(name))
    return spec if spec.design is not None else gj.changed(spec, tomllib.loads(design_block(spec)))


def write_share(name: str, seed: int, folder: Path, steps: int | None) -> None:
    """Search one preset's plan by one seed."""
    begun = time.process_time()
    row: dict[str, object] = {"name": name, "seed": seed, "steps": steps}
    try:
        *_, best = run_search(gj.changed(design(name), {"design.seed": seed}), steps=steps)
    except ValueError as error:
        row |= {"refused": str(error).splitlines()[0]}
    else:
        assert isinstance(best, Optimised)
        row |= outcome(best)
    row["processor_s"] = time.process_time() - begun
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}-{seed}.json").write_text(json.dumps(row, indent=1) + "\n")
    print(row, flush=True)


def outcome(best: Optimised) -> dict[str, object]:
    """Objective before and after."""
    return {
        "objective": f"{best.name} ({best.unit})",
        "before": best.before,
        "now": best.now,
        "kept": best.kept,
    }


def report(folder: Path) -> None:
    """The table of a folder's rows."""
    rows = sorted((json.loads(f.read_text()) for f in folder.glob("*.json")), key=lambda r: (r["name"], r["seed"]))
    done = [r for r in rows if "now" in r]
    worse = [r for r in done if r["before"] is not None and r["now"] > r["before"] * (1.0 + 1e-9)]
    lines = [
        "# Optima of the presets",
        "",
        f"By `python experiments/designs/presets.py`, {len({r['name'] for r in rows})} of {len(gj.presets.names())} "
        f"presets so far: {len(done)} searches, of which {len(worse)} ended worse than the file's own plan.",
        "",
        "| preset | seed | objective | before | now | kept | steps | processor time |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in done:
        before = "not observable" if r["before"] is None else f"{r['before']:.5g}"
        lines.append(
            f"| {r['name']} | {r['seed']} | {r['objective']} | {before} | {r['now']:.5g} | "
            f"{'yes' if r['kept'] else ''} | {r.get('steps') or 'all'} | {r['processor_s']:.0f} s |"
        )
    refused = {r["name"]: r["refused"] for r in rows if "refused" in r}
    lines += ["", *(f"* {name}: refused, {why}" for name, why in refused.items())]
    (HERE / "presets.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    """All presets, or one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--case", choices=gj.presets.names(), help="only this one, without the table")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--steps", type=int, help="of the search, as of `optimise`")
    parser.add_argument("--report", action="store_true", help="only the table, of the cases that are there")
    parser.add_argument("folder", type=Path, nargs="?", default=HERE / "presets", help="of the cases' files")
    asked = parser.parse_args()
    for name in () if asked.report else [asked.case] if asked.case else gj.presets.names():
        for seed in SEEDS if asked.seed is None else [asked.seed]:
            write_share(name, seed, asked.folder, asked.steps)
    if not asked.case:
        report(asked.folder)


if __name__ == "__main__":
    main()
