"""Five missions: a plan for ppm, a plan for the mission, and what no plan does better than.

    python experiments/missions/missions.py [--tables | --again | NAME …]

`--tables` writes the missions' tables (CSV) and specs alone; `--again` compares the kept plans without a search.
Otherwise every mission's plan (or those named) is
searched, and the plan for ppm that all have in common, in the same time, with the same freedom, both quickly;
`guarded` is the hover with a limit on the scale factor beside it. Specs with plans go to `plans/`, figures to
results.json and table.md here.
"""

import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax

HERE = Path(__file__).parent
# By how much the guarded plan may be worse in ppm than the one for ppm.
GUARD = 1.25
# Of a search that is quick.
STEPS = 120


def hover() -> Iterator[tuple[float, float, float]]:
    """A multirotor of ten minutes: it hovers, and yaws by whole turns, five to the right for each to the left."""
    for k in range(0, 6001, 5):
        t = k / 10.0
        within = t % 60.0
        sign = -1.0 if int(t // 60.0) % 6 == 5 else 1.0
        rate = sign * 90.0 * math.sin(math.pi * within / 20.0) ** 2 if within < 20.0 else 0.0
        yield t, rate, 22.0 + 14.0 * (1.0 - math.exp(-t / 200.0))


def survey() -> Iterator[tuple[float, float, float]]:
    """A fixed-wing aircraft of forty minutes: legs of 75 s, turned round at 12 deg/s, left and right by turns."""
    for t in range(2401):
        leg, within = divmod(float(t), 90.0)
        rate = 0.0 if within < 75.0 else (12.0 if int(leg) % 2 else -12.0)
        yield float(t), rate, 12.0 - 10.0 * (1.0 - math.exp(-t / 900.0))


def spin() -> Iterator[tuple[float, float, float]]:
    """A head that turns one way at 180 deg/s for five minutes."""
    for t in range(301):
        yield float(t), 180.0 * min(1.0, t / 5.0, (300 - t) / 5.0), 35.0 + 5.0 * t / 300.0


def pipeline() -> Iterator[tuple[float, float, float]]:
    """A tool in a pipeline for two hours: slow bends either way, in ground of 8 °C that warms it to 12."""
    for t in range(0, 7201, 5):
        yield float(t), 3.0 * math.sin(2.0 * math.pi * t / 400.0), 8.0 + 4.0 * t / 7200.0


MISSIONS = {"hover": hover, "survey": survey, "spin": spin, "pipeline": pipeline}
NAMES = (*MISSIONS, "north")
NORTH = """name        = "north"
quantity    = "north"
axis        = "x"
latitude    = "52 deg"
after       = "10 min"
temperature = ["0 degC", "10 degC"]
statistic   = "rms"
"""
TITLES = {
    "hover": "A multirotor hovers and yaws for ten minutes",
    "survey": "A fixed-wing aircraft surveys for forty minutes",
    "spin": "A head spins one way for five minutes",
    "pipeline": "A tool in a pipeline for two hours",
    "north": "A gyrocompass finds north in a cold store",
}


def write_tables() -> None:
    """The missions' tables, and a spec for each, which is the one for ppm with a requirement more."""
    text = (HERE / "ppm.toml").read_text(encoding="utf-8").partition("\n")[2]
    for name, title in TITLES.items():
        requirement = NORTH
        if name in MISSIONS:
            lines = ["time (s), rate (deg/s), temperature (degC)"]
            lines += [f"{t:g}, {rate:.3f}, {temperature:.3f}" for t, rate, temperature in MISSIONS[name]()]
            (HERE / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
            requirement = f'name     = "{name}"\nquantity = "mission_heading"\naxis     = "x"\n'
            requirement += f'mission  = "{name}.csv"\n'
        own = text.replace("For the scale factor over all temperatures and rates", title)
        own = own.replace("[plan]\n", f"[[requirement]]\n{requirement}\n[plan]\n", 1)
        own = own.replace('minimise = "scale factor"', f'minimise = "{name}"')
        (HERE / f"{name}.toml").write_text(f"# Made by missions.py from ppm.toml.\n{own}", encoding="utf-8")


def searched(name: str) -> dict[str, object]:
    """Search a plan and keep its spec in `plans/`. What the search said, and its time of processor (s)."""
    from gradcal_jax.design.optimise import optimise
    from gradcal_jax.spec.changes import changed
    from gradcal_jax.spec.spec import read_spec
    from gradcal_jax.tables.writing import write_toml

    spec = read_spec(HERE / f"{name.removeprefix('guarded ')}.toml")
    if name.startswith("guarded"):
        best = json.loads((HERE / "results.json").read_text(encoding="utf-8"))["ppm"]["left"]
        spec = changed(spec, {"requirement[0].target": f"{GUARD * best:.4g} ppm"})
    begun = time.process_time()
    found = optimise(spec, steps=STEPS, quick=True)
    took = time.process_time() - begun
    (HERE / "plans").mkdir(exist_ok=True)
    write_toml(found.spec, plan_of(name), header="Made by experiments/missions/missions.py.")
    return {"left": found.now, "converged": found.converged, "sentence": found.sentence, "seconds": round(took)}


def plan_of(name: str) -> Path:
    """Where a searched plan is kept."""
    return HERE / "plans" / f"{name.replace(' ', '_')}.toml"


def compared(name: str) -> dict[str, object]:
    """What the plan for ppm, and the mission's own, leave of the mission, and the limit for both."""
    from gradcal_jax.design.plan_limit import limit
    from gradcal_jax.information.prediction import predict
    from gradcal_jax.spec.changes import tables_of
    from gradcal_jax.spec.spec import read_spec, spec_of

    own, for_ppm = read_spec(plan_of(name)), read_spec(plan_of("ppm"))
    both = [predict(one).requirements for one in (own, spec_of(tables_of(own) | {"plan": tables_of(for_ppm)["plan"]}))]
    # Of what any plan may do, the chamber's programme free: not of this plan's own programme alone.
    asked = tables_of(read_spec(HERE / f"{name.removeprefix('guarded ')}.toml"))
    (proven,) = limit(spec_of(asked | {"requirement": asked["requirement"][1:]}))
    return {
        "unit": both[0][1].unit,
        "own": both[0][1].rms,
        "for ppm": both[1][1].rms,
        "limit": proven.certified,
        "relaxed": list(proven.relaxed),
        "noise": both[0][1].own,
        "ppm of own": both[0][0].mean_of_max,
        "ppm of both": both[1][0].mean_of_max,
    }


def table(results: dict[str, dict]) -> str:
    """The rows as Markdown."""
    lines = [
        "# Five missions",
        "",
        "`python experiments/missions/missions.py`; sensor, rig and time are those of ppm.toml for all, each mission's "
        "spec stands beside it. 1σ in degrees, exact for the rounded plans; by the model, with no device. The unit's "
        "own noise is what no calibration takes off.",
        "",
        "| mission | plan for ppm | its own plan | better by | no plan below | own noise | its ppm | search, s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in [n for n in (*NAMES, "guarded hover") if "own" in results.get(n, {})]:
        r = results[name]
        gain, least = 1.0 - r["own"] / r["for ppm"], "—" if r["limit"] is None else f"{r['limit']:.3g}"
        lines.append(
            f"| {name} | {r['for ppm']:.4g} | {r['own']:.4g} | {gain:.0%} | {least} | {r['noise']:.3g} | "
            f"{r['ppm of own']:.4g} | {r['seconds'] or '—'} |"
        )
    best = results.get("ppm", {}).get("left")
    lines += [
        "",
        f"The plan for ppm leaves {best:.4g} ppm. `guarded hover` is searched for the hover with at most {GUARD:g} "
        "times that as the target of the scale factor. Times are of processor, all threads together.",
        "",
        "What the limits relax:",
        "",
    ]
    lines += [f"* {name}: {'; '.join(results[name]['relaxed'])}" for name in NAMES if "own" in results.get(name, {})]
    return "\n".join(lines) + "\n"


def main(names: list[str]) -> None:
    """Search the named plans, or all, and write the table."""
    write_tables()
    if names == ["--tables"]:
        return
    jax.config.update("jax_enable_x64", True)
    kept = HERE / "results.json"
    results = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    again = names == ["--again"]
    for name in (list(results) if again else names) or ["ppm", *NAMES, "guarded hover"]:
        print(f"{name} …", flush=True)
        if not again:
            results[name] = searched(name)
        if name != "ppm":
            results[name] |= compared(name)
            results[name]["left"] = results[name]["own"]
        jax.clear_caches()
        print(f"  {results[name]}", flush=True)
        kept.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        (HERE / "table.md").write_text(table(results), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
