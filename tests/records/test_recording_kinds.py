"""Kinds of recordings that people have: stamps in bursts, units in headers, marks of thousands, coarse thermometers,
spikes and dead bands. Each with its truth: white noise of a known angle random walk, or a question that names the kind.
"""

from pathlib import Path

import numpy as np
import pytest

from gradcal_jax import identify
from gradcal_jax.identify.instability import at_rest
from gradcal_jax.records.importers import import_log, parse_column_map
from gradcal_jax.records.log import Log
from gradcal_jax.units import DEG_PER_SQRT_H

N = 0.3  # deg/sqrt(h)
HEAD = 'format = "gradcal-columns/1"\n'
MAP = HEAD + 'time = { column = "t", unit = "s" }\nrate.x = { column = "gx", unit = "deg/s" }\n'


def noise(rows: int, hz: float, seed: int = 1) -> np.ndarray:
    """deg/s, of a bias of 0.02 deg/s."""
    return 0.02 + np.random.default_rng(seed).standard_normal(rows) * N / 60.0 * np.sqrt(hz)


def imported(folder: Path, time: np.ndarray, rate: np.ndarray, text: str = MAP, digits: int = 6) -> Log:
    rows = "".join(f"{t:.9g},{v:.{digits}f}\n" for t, v in zip(time, rate, strict=True))
    (folder / "record.csv").write_text("t,gx\n" + rows, encoding="utf-8")
    return import_log(folder / "record.csv", parse_column_map(text))


def walk(log: Log) -> float:
    """N of the first axis, deg/sqrt(h)."""
    rest = at_rest(log)
    fit = identify.fit_allan(identify.overlapping_allan(rest.rate, rest.sample_interval_s, valid=rest.valid))
    return fit.angle_random_walk.value * DEG_PER_SQRT_H


def kinds(log: Log) -> list[str]:
    return [finding.kind for finding in log.findings]


@pytest.mark.parametrize("size", [2, 10])
@pytest.mark.parametrize("kind", ["a gap between bursts", "rows lost within bursts"])
def test_bursts_with_losses_keep_the_rate_of_the_clock(size: int, kind: str, tmp_path: Path):
    k = np.arange(20_000)
    kept = np.random.default_rng(3).random(len(k)) > 0.03 if "rows" in kind else (k < 8000) | (k >= 9000)
    time = ((k // size) * size + (k % size) * 0.02) / 200.0
    log = imported(tmp_path, time[kept], noise(len(k), 200.0)[kept])
    assert set(kinds(log)) == {"uneven stamps", "gap"}
    assert log.sample_interval_s == pytest.approx(0.005, rel=1e-3)
    assert walk(log) == pytest.approx(N, rel=0.05)


def test_sound_stamps_are_kept_to_the_last_digit(tmp_path: Path):
    for hz in (1.0, 50.0, 100.0, 1000.0):
        time = np.arange(5000) / hz + 1e-5 * np.random.default_rng(2).standard_normal(5000)
        log = imported(tmp_path, np.round(time, 8), noise(5000, hz))
        assert not [kind for kind in kinds(log) if kind in ("gap", "uneven stamps")]
        assert np.array_equal(log.time_s, np.array([float(f"{t:.9g}") for t in np.round(time, 8)]) - log_start(time))


def log_start(time: np.ndarray) -> float:
    return float(f"{np.round(time[0], 8):.9g}")


def test_the_plateau_of_a_coarse_thermometer_is_no_fault(tmp_path: Path):
    time = np.arange(72_000) * 0.1
    warm = 20.0 + 25.0 * (1.0 - np.exp(-time / 600.0))
    text = MAP + 'temperature = { column = "temp", unit = "degC" }\n'
    for spread in (0.0, 0.05):  # without noise, and with some, which dithers at the steps
        shown = np.rint(warm + spread * np.random.default_rng(2).standard_normal(len(time)))
        rows = zip(time, noise(len(time), 10.0), shown, strict=True)
        body = "".join(f"{t:.2f},{v:.6f},{c:.0f}\n" for t, v, c in rows)
        (tmp_path / "record.csv").write_text("t,gx,temp\n" + body, encoding="utf-8")
        log = import_log(tmp_path / "record.csv", parse_column_map(text))
        assert log.counts() == {"used": len(time)}


def test_rare_wrong_rows_are_left_out_and_said(tmp_path: Path):
    rate = noise(60_000, 100.0)
    rate[::2000] += 20.0
    rate[500:30_000:3000] = 0.02 - 15.0
    log = imported(tmp_path, np.arange(len(rate)) / 100.0, rate)
    rest = at_rest(log)
    assert np.count_nonzero(~rest.valid) == 40
    words = "40 rows (0.00067 of all) differ from their neighbours by more than 10 standard deviations"
    assert words in rest.messages[0]
    assert walk(log) == pytest.approx(N, rel=0.03)
