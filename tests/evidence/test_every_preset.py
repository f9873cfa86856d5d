"""Every preset and every spec and recipe of the experiments, from plan to calibration: recipe, simulated run, log,
estimate, three seeds each; the errors against the hidden truth, and what was promised against what was reached."""

import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chain import Chain, chain, predicted_of, recipe_of, widened
from evidence_report import ReportTable, Rows
from scipy.stats import chi2

import gradcal_jax as gj
from gradcal_jax.spec import presets

ROOT = Path(__file__).parents[2]
PRESETS = presets.names()
_KNOWN = [tomllib.loads(presets.text(name)) for name in PRESETS]


def _is_own_plan(path: Path) -> bool:
    """Whether a file is a spec or a recipe, and none of the presets in other words."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    return table.get("format") in ("gradcal-spec/1", "gradcal-recipe/1") and table not in _KNOWN


EXPERIMENTS = tuple(
    str(path.relative_to(ROOT)) for path in sorted((ROOT / "experiments").rglob("*.toml")) if _is_own_plan(path)
)
ALL = (*PRESETS, *EXPERIMENTS)
# In the suite itself: the paper's, one static, one standard, a unit on two axes, and one by hand. Thinned: ramps of
# some twenty minutes in the place of hours, and requirements ("box") within the temperatures that are left.
QUICK = {
    "paper-dynamic-gradient": {
        "plan.temperature": ["10 degC", "40 degC"],
        "plan.gradient": "1.5 K/min",
        "plan.soak": "5 min",
        "box": ["15 degC", "35 degC"],
    },
    "paper-static-gradient": {
        "plan.temperature": ["10 degC", "30 degC"],
        "plan.soak": "5 min",
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
        "plan.soak": "5 min",
        "sensor.thermal_lag": "20 s",
        "box": ["8 degC", "30 degC"],
    },
    "gimbal-by-hand": {
        "plan.temperature": ["10 degC", "30 degC"],
        "plan.gradient": "1 K/min",
        "plan.soak": "1 min",
        "box": ["14 degC", "26 degC"],
    },
}


@dataclass
class Seeds:
    """Chains of one recipe."""

    chains: list[Chain]

    @property
    def degrees(self) -> int:
        return sum(one.degrees for one in self.chains)

    @property
    def band(self) -> tuple[float, float]:
        """99 % of χ²."""
        low, high = chi2.ppf([0.005, 0.995], self.degrees)
        return low, high

    @property
    def truth(self) -> dict[str, float]:
        """χ² of the hidden truth over all seeds, by three ways, of one sensor the same."""
        found = {"": sum(one.nees for one in self.chains)}
        if all(one.squares is not None for one in self.chains):
            found[" by the data"] = sum(one.squares or 0.0 for one in self.chains)
            found[", elements,"] = sum(one.elements for one in self.chains)
        return found

    @property
    def ratios(self) -> list[tuple[str, float]]:
        """Achieved over predicted, of every seed and requirement."""
        return [(name, r / widened(one.fit)) for one in self.chains for name, r in one.ratios.items()]

    @property
    def apart(self) -> list[str]:
        """The ratios that are not within 10 %."""
        return [f"{name}: {r:.3f} of what was predicted" for name, r in self.ratios if abs(r - 1.0) > 0.10]

    @property
    def beyond(self) -> list[str]:
        """The truth's χ² that are not in their band."""
        low, high = self.band
        return [
            f"χ² of the hidden truth{how} {value:.1f} of {self.degrees} ({low:.0f} … {high:.0f})"
            for how, value in self.truth.items()
            if not low < value < high
        ]

    @property
    def range(self) -> str:
        if not self.ratios:
            return "–"
        values = [r for _, r in self.ratios]
        return f"{min(values):.3f} … {max(values):.3f}, mean {np.mean(values):.3f}"


_HEAD = """# Every preset, spec and recipe, from plan to calibration

Made by `pytest -m evidence tests/evidence/test_every_preset.py`: recipe, run on simulated devices, log and estimate by
the command line. χ² of the hidden truth: the calibration's errors in its own covariance, all seeds together, with its
99 % band. Of IMUs, whose model is not linear, the errors are those that the difference of what the model expects
amounts to; "by the data": what the truth's weighted squares exceed those of the estimate by; "elements": of
misalignments times scale factors, linear in all else. All three must lie in the band. Reached over predicted: of every
requirement and seed, without what the estimate widens for its fit. A prediction is of ideal sensors: if one of its
ratios is beyond 10 %, a plan of an IMU is run again with sensors that are hardly misaligned.
"""


def means(rows: Rows) -> list[float]:
    return [float(row[5].split("mean ")[1]) for row in rows if "mean " in row[5]]


def _foot(rows: Rows) -> str:
    missing = {f"`{name}`" for name in ALL} - {row[0] for row in rows}
    foot = f"Mean of {len(means(rows))} means: {np.mean(means(rows)):.3f}; {time.strftime('%Y-%m-%d')}."
    return f"{foot}\n\nNot run yet: {', '.join(sorted(missing))}." if missing else foot


_COLUMNS = ("what", "seeds", "χ² of the truth", "of", "band", "reached over predicted", "not as promised")
REPORT = ReportTable("presets", _HEAD, _COLUMNS, foot=_foot)


def report(name: str, seeds: Seeds, ideal: Seeds | None) -> None:
    words = "; ".join(dict.fromkeys([*seeds.beyond, *seeds.apart]))[:200] or "–"
    if ideal is not None:
        words += f"; hardly misaligned {ideal.range}"
    squares = ";".join(f"{how} {value:.1f}" for how, value in seeds.truth.items()).strip()
    low, high = seeds.band
    REPORT.put((f"`{name}`", len(seeds.chains), squares, seeds.degrees, f"{low:.0f} … {high:.0f}", seeds.range, words))


def thinned(spec: gj.Spec, changes: dict[str, Any]) -> gj.Spec:
    """With some keys set; "box": the temperatures of all requirements."""
    boxes = {f"requirement[{k}].temperature": changes["box"] for k in range(len(spec.requirement))}
    return gj.changed(spec, boxes | {key: value for key, value in changes.items() if key != "box"})


def hardly_misaligned(spec: gj.Spec) -> gj.Spec:
    kinds = [kind for kind in ("gyro", "accelerometer") if getattr(getattr(spec.sensor, kind), "misalignment", None)]
    return gj.changed(spec, {f"sensor.{kind}.misalignment.prior": "0.001 mrad" for kind in kinds})


def seeds_of(path: Path, folder: Path, count: int) -> Seeds:
    recipe = recipe_of(path, folder)
    predicted = predicted_of(recipe, folder)
    return Seeds([chain(recipe, predicted, folder, seed) for seed in range(1, count + 1)])


@pytest.mark.evidence
@pytest.mark.parametrize("name", ALL)
def test_what_is_promised_is_reached(name: str, tmp_path: Path) -> None:
    path = tmp_path / "spec.toml"
    path.write_text((ROOT / name).read_text("utf-8") if name in EXPERIMENTS else presets.text(name), encoding="utf-8")
    seeds, ideal = seeds_of(path, tmp_path, 3), None
    if seeds.apart and len(seeds.truth) > 1:
        gj.write_toml(hardly_misaligned(gj.read_recipe(recipe_of(path, tmp_path)).spec), tmp_path / "aligned.toml")
        ideal = seeds_of(tmp_path / "aligned.toml", tmp_path, 3)
    report(name, seeds, ideal)
    assert not seeds.beyond
    assert not (ideal or seeds).apart
    ratios = [r for _, r in seeds.ratios]
    assert not ratios or abs(np.mean(ratios) - 1.0) < 0.10
    assert abs(np.mean(means(REPORT.rows())) - 1.0) < 0.03


@pytest.mark.long
@pytest.mark.parametrize("name", QUICK)
def test_a_short_run_of_a_preset_reaches_what_is_promised(name: str, tmp_path: Path) -> None:
    gj.write_toml(thinned(gj.parse_spec(presets.text(name)), QUICK[name]), tmp_path / "spec.toml")
    seeds = seeds_of(tmp_path / "spec.toml", tmp_path, 1)
    assert not [*seeds.beyond, *seeds.apart], seeds.chains[0].printed
