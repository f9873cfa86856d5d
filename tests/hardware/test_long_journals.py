"""A journal of a day does not fit into memory: what reads it keeps events, or goes through it once."""

import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments" / "benchmarks"))
from journal_memory import made

from gradcal_jax.decoding.run_log import log
from gradcal_jax.hardware.journal import Journal, read_journal
from gradcal_jax.hardware.run_folder import RunFolder, prepare_resume
from gradcal_jax.hardware.stretches import goes_on_at, stretches_of


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


def test_a_log_takes_little_more_memory_than_its_rows(run: Path) -> None:
    logs = []
    peak = peak_mb(lambda: logs.append(log(run)))
    rows = len(logs[0].time_s)
    assert rows > 150_000
    # Of a row the log holds some hundred bytes, its samples as they were decoded some fifty.
    assert 1e6 * peak / rows < 300.0


def test_a_damaged_journal_is_read_alike_in_one_piece_and_in_blocks(run: Path, tmp_path: Path) -> None:
    data = bytearray((run / "journal").read_bytes()[: 6 << 20])
    for place in range(1000, len(data), 1 << 20):
        data[place] ^= 0x55
    (tmp_path / "journal").write_bytes(data)
    whole, events = read_journal(tmp_path / "journal"), read_journal(tmp_path / "journal", chunks=False)
    assert 0 < whole.damaged_bytes == events.damaged_bytes
    assert [event.name for event in whole.events] == [event.name for event in events.records]
