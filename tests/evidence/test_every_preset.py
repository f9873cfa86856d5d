"""Every preset and every spec and recipe of the experiments, from plan to calibration: recipe, simulated run, log,
estimate, three seeds each; the errors against the hidden truth, and what was promised against what was reached."""

import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from chain import AIR_LAG_S, Chain, chain, predicted_of, recipe_of
from scipy.stats import chi2

from gradcal_jax.spec import presets

ROOT = Path(__file__).parents[2]
REPORT = ROOT / "experiments" / "evidence" / "presets.md"
PRESETS = presets.names()
EXPERIMENTS = tuple(
    str(path.relative_to(ROOT))
    for path in sorted((ROOT / "experiments").rglob("*.toml"))
    if tomllib.loads(path.read_text(encoding="utf-8")).get("format") in ("gradcal-spec/1", "gradcal-recipe/1")
)
# In the suite itself: the paper's, one static, one standard, a unit on two axes, and one by hand. Thinned: ramps of
# some twenty minutes in the place of hours, and requirements ("box") within the temperatures that are left.
QUICK = {
    "paper-dynamic-gradient": {
        "plan.temperature": ["10 degC", "40 degC"],
        "plan.gradient": "1.5 K/min",
        "plan.soak.duration": "5 min",
        "box": ["15 degC", "35 degC"],
    },
    "paper-static-gradient": {
        "plan.temperature": ["10 degC", "30 degC"],
        "plan.soak.duration": "5 min",
        "box": ["14 degC", "26 degC"],
    },
    "paper-dynamic-standard": {
        "plan.temperatures": ["0 degC", "10 degC", "20 degC", "30 degC"],
        "plan.soak": "10 min",
        "plan.integration": "2 min",
        "box": ["0 degC", "30 degC"],
    },
    "two-axis-table": {
        "plan.temperature": ["5 degC", "35 degC"],
        "plan.gradient": "2 K/min",
        "plan.soak.duration": "5 min",
        "sensor.thermal_lag": "20 s",
        "box": ["8 degC", "30 degC"],
    },
    "gimbal-by-hand": {
        "plan.temperature": ["10 degC", "30 degC"],
        "plan.gradient": "1 K/min",
        "plan.soak.duration": "1 min",
        "box": ["14 degC", "26 degC"],
    },
}
ALL = (*PRESETS, *EXPERIMENTS)


@dataclass
class Seeds:
    """Chains of one recipe."""

    name: str
    chains: list[Chain] = field(default_factory=list[Chain])

    @property
    def chance(self) -> tuple[float, int]:
        """χ² of the hidden truth over all seeds, and its degrees of freedom."""
        return sum(one.nees for one in self.chains), sum(one.degrees for one in self.chains)

    @property
    def squares(self) -> float | None:
        """The same by the data alone, of IMUs."""
        found = [one.squares for one in self.chains if one.squares is not None]
        return sum(found) if found else None

    @property
    def elements(self) -> float:
        """The same of elements of the matrices, linear in all else."""
        return sum(one.elements for one in self.chains)

    @property
    def ratios(self) -> np.ndarray:
        """Achieved over predicted, of every seed and requirement."""
        return np.array([ratio / one.wider for one in self.chains for ratio in one.ratios.values()])

    @property
    def apart(self) -> list[str]:
        """The ratios that are not within 10 %."""
        return [
            f"{requirement}: {ratio / one.wider:.3f} of what was predicted"
            for one in self.chains
            for requirement, ratio in one.ratios.items()
            if abs(ratio / one.wider - 1.0) > 0.10
        ]

    def faults(self) -> list[str]:
        """What does not hold: the truth's χ² in its 99 % band, and each ratio within 10 %."""
        nees, degrees = self.chance
        low, high = chi2.ppf([0.005, 0.995], degrees)
        squares = nees if self.squares is None else self.squares
        ways = (("", nees), (" by the data", squares), (", elements,", self.elements))
        found = [
            f"χ² of the hidden truth{how} {value:.1f} of {degrees} ({low:.0f} … {high:.0f})"
            for how, value in ways
            if not low < value < high
        ]
        return found + self.apart


_HEAD = """# Every preset, spec and recipe, from plan to calibration

Made by `pytest -m evidence tests/evidence/test_every_preset.py`: recipe, run on simulated devices, log and estimate by
the command line. χ² of the hidden truth: the calibration's errors in its own covariance, all seeds together, with its
99 % band. Of IMUs, whose model is not linear, the errors are those that the difference of what the model expects
amounts to; "by the data": what the truth's weighted squares exceed those of the estimate by; "elements": of
misalignments times scale factors, linear in all else. All three must lie in the band. Reached over predicted: of every
requirement and seed, without what the estimate widens for its fit. A prediction is of ideal sensors: if one of its
ratios is beyond 10 %, a plan of an IMU is run again with sensors that are hardly misaligned.

| what | seeds | χ² of the truth | of | band | reached over predicted | not as promised |
|---|---|---|---|---|---|---|
"""


def report(name: str, seeds: Seeds | None = None, ideal: Seeds | None = None) -> None:
    """Write or replace the row of a recipe, without its runs remove it; and the mean over all."""
    rows: dict[str, str] = {}
    if REPORT.exists():
        for line in REPORT.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.strip("|").split(" | ")]
            if len(cells) == 7 and cells[0] not in ("what", "---"):
                rows[cells[0]] = line
    rows.pop(f"`{name}`", None)
    if seeds is not None:
        rows[f"`{name}`"] = row_of(seeds, ideal)
    means = [float(row.split("mean ")[1].split(" ")[0]) for row in rows.values() if "mean " in row]
    foot = f"\nMean of {len(means)} means: {np.mean(means):.3f}; {time.strftime('%Y-%m-%d')}.\n" if means else ""
    if missing := [f"`{name}`" for name in ALL if f"`{name}`" not in rows]:
        foot += f"\n{len(missing)} of {len(ALL)} are not run yet: {', '.join(missing)}.\n"
    REPORT.write_text(_HEAD + "\n".join(rows[name] for name in sorted(rows)) + "\n" + foot, encoding="utf-8")


def row_of(seeds: Seeds, ideal: Seeds | None) -> str:
    nees, degrees = seeds.chance
    low, high = chi2.ppf([0.005, 0.995], degrees)
    ratios = seeds.ratios
    within = f"{ratios.min():.3f} … {ratios.max():.3f}, mean {ratios.mean():.3f}" if len(ratios) else "–"
    words = "; ".join(dict.fromkeys(seeds.faults())) or "–"
    if ideal is not None:
        words += f"; hardly misaligned {ideal.ratios.min():.3f} … {ideal.ratios.max():.3f}"
    squares = f"{nees:.1f}"
    if seeds.squares is not None:
        squares += f"; by the data {seeds.squares:.1f}; elements {seeds.elements:.1f}"
    cells = (f"{len(seeds.chains)}", squares, f"{degrees}", f"{low:.0f} … {high:.0f}", within, words[:200])
    return f"| `{seeds.name}` | {' | '.join(cells)} |"


def written(name: str, folder: Path, changes: dict[str, object] | None = None) -> Path:
    """A preset's spec, thinned, or a file of the experiments."""
    if name in EXPERIMENTS:
        return ROOT / name
    path = folder / "spec.toml"
    text = presets.text(name)
    path.write_text(thinned(text, changes) if changes else text, encoding="utf-8")
    return path


def thinned(text: str, changes: dict[str, object]) -> str:
    """A spec's text with some keys set; "box": the temperatures of all requirements."""
    tables = tomllib.loads(text)
    for requirement in tables["requirement"]:
        requirement["temperature"] = changes["box"]
    for key, value in changes.items():
        if key == "box":
            continue
        *path, last = key.split(".")
        here = tables
        for part in path:
            here = here[part]
        here[last] = value
    return tomlkit.dumps(tables)


def hardly_misaligned(path: Path, folder: Path) -> Path:
    """The spec of a file, with sensors that are."""
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    tables = tables.get("spec", tables)
    for kind in ("gyro", "accelerometer"):
        if "misalignment" in tables["sensor"].get(kind, {}):
            tables["sensor"][kind]["misalignment"]["prior"] = "0.001 mrad"
    (folder / "aligned.toml").write_text(tomlkit.dumps(tables), encoding="utf-8")
    return folder / "aligned.toml"


def seeds_of(
    name: str, folder: Path, count: int, changes: dict[str, object] | None = None, *, ideal: bool = False
) -> Seeds:
    folder.mkdir(exist_ok=True)
    path = written(name, folder, changes)
    recipe = recipe_of(hardly_misaligned(path, folder) if ideal else path, folder)
    predicted = predicted_of(recipe, AIR_LAG_S)
    return Seeds(name, [chain(recipe, predicted, folder, seed) for seed in range(1, count + 1)])


@pytest.mark.evidence
@pytest.mark.parametrize("name", ALL)
def test_what_is_promised_is_reached(name: str, tmp_path: Path) -> None:
    report(name)
    seeds = seeds_of(name, tmp_path, 3)
    again = bool(seeds.apart) and seeds.squares is not None
    ideal = seeds_of(name, tmp_path / "ideal", 3, ideal=True) if again else None
    report(name, seeds, ideal)
    assert not set(seeds.faults()) - set(seeds.apart if again else [])
    assert ideal is None or not ideal.apart
    assert len(seeds.ratios) == 0 or abs(seeds.ratios.mean() - 1.0) < 0.10


@pytest.mark.evidence
def test_the_mean_of_all_is_what_is_promised() -> None:
    """Of the committed report."""
    (foot,) = (line for line in REPORT.read_text(encoding="utf-8").splitlines() if line.startswith("Mean of"))
    assert abs(float(foot.split(": ")[1].split(";")[0]) - 1.0) < 0.03, foot


@pytest.mark.long
@pytest.mark.parametrize("name", QUICK)
def test_a_short_run_of_a_preset_reaches_what_is_promised(name: str, tmp_path: Path) -> None:
    seeds = seeds_of(name, tmp_path, 1, QUICK[name])
    assert not seeds.faults(), seeds.chains[0].printed
