"""Lots of simulated IMUs with one, three and no repeating shapes: what `gradcal lot` says against what was drawn.

Every IMU is read at its own temperatures and fitted by plain least squares (`tests/lot_scene.py`), so that calibrations
differ in their covariance and nothing of the package makes the data. Intervals are of 95 %; tests at 1 %, of strangers
over the whole lot.
"""

import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from lot_scene import MEAN, calibrations, drawn_maps, read_maps, spread_at

from gradcal_jax.estimation.calibrations import LotMap, lot

pytestmark = pytest.mark.evidence

REPORT = Path(__file__).parents[2] / "experiments" / "evidence" / "lots.md"
KINDS, UNITS, LOTS = {"one": 1, "three": 3, "no": None}, 20, 240
# Size of a stranger's deviation, in standard deviations of what the type and its calibration may be.
SIZES = (12.0, 24.0)
# Of the orthonormal functions over the range: Legendre polynomials' Gram matrix of powers.
GRID = np.linspace(-1.0, 1.0, 41)
POWERS = np.stack([GRID**k for k in range(4)], axis=1)

_HEAD = """# Lots: many calibrations of one type

Made by `pytest -m evidence tests/evidence/test_lot_coverage.py`: simulated lots of 20 IMUs with one, three and no
repeating shapes among four coefficients, each IMU calibrated by least squares of 12 to 60 readings of its own.
Coverage: of the 95 % intervals of mean and spread, of all lots and temperatures. A stranger differs by 12 to 24
standard deviations of type and calibration, in a direction drawn at random. Right count: as many shapes as there
are, or the sentence that they do not repeat; prior: one is written; false stranger: lots without any in which one
is named.

| shapes | lots | mean within | spread within | right count | prior | false stranger | stranger found | no other named |
|---|---|---|---|---|---|---|---|---|
"""

_GROUPS = """
Lots of 24 IMUs with one shape: split into groups where there is one type, and into exactly the two groups where eight
differ by some 30 deg/h at the ends of the range (the type: 9 deg/h).

| | one type split | both groups exactly |
|---|---|---|
"""


@lru_cache
def sound(kind: str) -> list[LotMap]:
    found = []
    for seed in range(LOTS):
        rng = np.random.default_rng([seed, 1])
        found.append(lot(calibrations(*read_maps(rng, drawn_maps(rng, UNITS, kind)))).maps[0])
    return found


@lru_cache
def with_stranger(kind: str) -> list[LotMap]:
    """One of the IMUs, the first, differs."""
    found = []
    for seed in range(LOTS):
        rng = np.random.default_rng([seed, 2])
        maps = drawn_maps(rng, UNITS, kind)
        values, covariances = read_maps(rng, maps)
        sample = drawn_maps(rng, 4000, kind)
        whole = np.cov(sample.T) + covariances[0]
        direction = rng.standard_normal(4)
        direction /= np.linalg.norm(direction)
        values[0] = MEAN + np.linalg.cholesky(whole) @ direction * rng.uniform(*SIZES)
        found.append(lot(calibrations(values, covariances)).maps[0])
    return found


def coverage(maps: list[LotMap], kind: str) -> tuple[float, float]:
    """Shares of lots and temperatures whose intervals contain the truth, of the mean and of the spread."""
    mean, spread, inside = POWERS @ MEAN, spread_at(kind, POWERS), [[], []]
    for one in maps:
        assert one.temperature_c == pytest.approx(20.0 + 50.0 * GRID)
        inside[0].append(np.abs(one.mean - mean) < one.mean_half)
        inside[1].append((one.spread_interval[0] <= spread) & (spread <= one.spread_interval[1]))
    return float(np.mean(inside[0])), float(np.mean(inside[1]))


def report(kind: str, cells: tuple[str, ...]) -> None:
    """Write or replace the row of a kind."""
    rows = {}
    if REPORT.exists():
        lines = REPORT.read_text(encoding="utf-8").splitlines()
        rows = {name: line for line in lines for name in (*KINDS, "groups") if line.startswith(f"| {name} |")}
    rows[kind] = f"| {kind} | {' | '.join(cells)} |"
    rest = "\n".join(rows[k] for k in KINDS if k in rows)
    groups = f"{_GROUPS}{rows['groups']}\n" if "groups" in rows else ""
    REPORT.write_text(f"{_HEAD}{rest}\n{groups}\n{time.strftime('%Y-%m-%d')}\n", encoding="utf-8")


@pytest.mark.parametrize("kind", KINDS)
def test_coverage_strangers_and_refusals(kind):
    plain, strange = sound(kind), with_stranger(kind)
    mean, spread = coverage(plain, kind)
    counted = np.mean([one.shape_count == KINDS[kind] for one in plain])
    written = np.mean([one.prior is not None for one in plain])
    false = np.mean([bool(one.strangers) for one in plain])
    found = np.mean(["no. 1" in [s.serial_number for s in one.strangers] for one in strange])
    alone = np.mean([[s.serial_number for s in one.strangers] == ["no. 1"] for one in strange])
    shares = (mean, spread, counted, written, false, found, alone)
    report(kind, (f"{LOTS}", *(f"{100.0 * share:.1f} %" for share in shares)))
    assert 0.93 <= mean <= 0.97
    assert 0.93 <= spread <= 0.97
    assert counted >= 0.97
    assert written >= 0.95 if KINDS[kind] else written == 0.0
    # The stated 1 % of lots, with four standard errors of so many.
    assert false <= 0.01 + 4.0 * np.sqrt(0.01 * 0.99 / LOTS)
    assert found >= 0.99
    assert alone >= 0.97


def test_two_groups_are_found_and_one_type_is_one_group():
    """Eight of 24 IMUs differ by some 30 deg/h at the ends of the range, where the type has 9 deg/h."""
    split = false = 0
    for seed in range(100):
        rng = np.random.default_rng([seed, 3])
        maps = drawn_maps(rng, 24, "one")
        false += bool(lot(calibrations(*read_maps(rng, maps))).maps[0].groups)
        maps[::3] += np.array([8.0, 20.0, -16.0, 12.0])
        groups = lot(calibrations(*read_maps(rng, maps))).maps[0].groups
        split += {frozenset(g) for g in groups} == {
            frozenset(f"no. {k + 1}" for k in range(24) if k % 3 == part or (part and k % 3)) for part in (0, 1)
        }
    report("groups", (f"{false} of 100", f"{split} of 100"))
    assert false <= 5
    assert split >= 90
