"""A journal of a day does not fit into memory: what reads it keeps events, or goes through it once."""

import errno
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments" / "benchmarks"))
from hardware_bench import fit_clock
from journal_memory import made

from gradcal_jax.cli import main
from gradcal_jax.hardware.journal import Journal, read_journal
from gradcal_jax.hardware.run_folder import RunFolder, goes_on_at, prepare_resume, stretches_of
from gradcal_jax.records import clockmap, row_times, spool
from gradcal_jax.records.log_file import write_log
from gradcal_jax.records.run_log import log, log_in_blocks


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of three quarters of an hour: 10 MB."""
    return made(tmp_path_factory.mktemp("long"), 0.75)


def peak_mb(work: Callable[[], object]) -> float:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def test_what_resumes_or_watches_a_run_takes_little_memory(run: Path) -> None:
    folder = RunFolder(run)
    assert folder.journal_path.stat().st_size > 9e6
    for work in (
        lambda: prepare_resume(folder),
        lambda: Journal(folder.journal_path).close(),
        lambda: (stretches_of(folder), goes_on_at(folder)),
    ):
        # Two blocks of four megabytes and the events.
        assert peak_mb(work) < 13.0


@pytest.mark.long
def test_a_log_is_written_in_little_memory_whatever_its_length(run: Path, tmp_path: Path) -> None:
    with log_in_blocks(run) as found:
        assert found.rows > 250_000
        # The journal's block, a block of samples and what is made of it, and the events; whole it is 40 MB.
        assert peak_mb(lambda: write_log(found, tmp_path / "log.nc")) < 25.0
    assert peak_mb(lambda: main(["log", str(run), "-o", str(tmp_path / "other.nc")])) < 60.0
    assert (tmp_path / "other.nc").read_bytes() == (tmp_path / "log.nc").read_bytes()


@pytest.mark.long
def test_a_log_that_is_read_whole_takes_little_more_memory_than_its_rows(run: Path) -> None:
    logs = []
    peak = peak_mb(lambda: logs.append(log(run)))
    # Of a row the log holds ninety bytes.
    assert 1e6 * peak / len(logs[0].time_s) < 200.0


@pytest.mark.parametrize("rows", [5000, 4097])
def test_the_size_of_the_blocks_changes_nothing(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    write_log(log(run), tmp_path / "whole.nc")
    monkeypatch.setattr(spool, "BLOCK", rows)
    monkeypatch.setattr(row_times, "_STEP", rows // 7)
    assert main(["log", str(run), "-o", str(tmp_path / "log.nc")]) == 0
    assert (tmp_path / "log.nc").read_bytes() == (tmp_path / "whole.nc").read_bytes()


def test_a_clock_is_the_same_whether_its_arrivals_are_read_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(4)
    device = np.arange(20_000) * 0.064
    host = 1000.0 + (1.0 + 3e-5) * device + random.exponential(1e-3, len(device))
    at_once = fit_clock(device, host, resolution_s=1e-6)
    monkeypatch.setattr(clockmap, "_SPAN", 777)
    in_spans = fit_clock(device, host, resolution_s=1e-6)
    assert (in_spans.used, in_spans.late) == (at_once.used, at_once.late)
    for name in ("offset_s", "rate", "rate_std", "residual_rms_s", "residual_max_s"):
        assert getattr(in_spans, name) == pytest.approx(getattr(at_once, name), rel=1e-9)


def test_a_disk_that_fills_while_samples_are_decoded_is_a_sentence(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: spool.Spool, first: int, rows: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(self.folder))

    monkeypatch.setattr(spool.Spool, "write", full)
    assert main(["log", str(run), "-o", str(tmp_path / "log.nc")]) == 2
    assert f"{tmp_path}: No space left on device" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_a_damaged_journal_is_read_alike_in_one_piece_and_in_blocks(run: Path, tmp_path: Path) -> None:
    data = bytearray((run / "journal").read_bytes()[: 6 << 20])
    for place in range(1000, len(data), 1 << 20):
        data[place] ^= 0x55
    (tmp_path / "journal").write_bytes(data)
    whole, events = read_journal(tmp_path / "journal"), read_journal(tmp_path / "journal", chunks=False)
    assert 0 < whole.damaged_bytes == events.damaged_bytes
    assert [event.name for event in whole.events] == [event.name for event in events.records]
