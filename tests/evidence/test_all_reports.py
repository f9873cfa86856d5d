"""Reports of evidence are of today's program, or a proof says which are not."""

import importlib.util
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).parents[2] / "experiments" / "evidence" / "all.py"
SPEC = importlib.util.spec_from_file_location("all_reports", PATH)
assert SPEC is not None
assert SPEC.loader is not None
reports = sys.modules["all_reports"] = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(reports)


def test_each_report_names_tests_and_rooms_that_exist():
    root = PATH.parents[2]
    for report in reports.ALL:
        places = [word for word in report.tests if not word.startswith("--")]
        assert places
        assert all((root / place).exists() for place in places), report.name
        assert all((root / "gradcal_jax" / room).is_dir() for room in report.rooms), report.name


def test_a_changed_room_makes_its_report_stale(monkeypatch, tmp_path):
    monkeypatch.setattr(reports, "ROOT", tmp_path)
    module = tmp_path / "gradcal_jax" / "model" / "terms.py"
    module.parent.mkdir(parents=True)
    module.write_text('"""One."""\nx = 1\n')
    before = reports.digest_of_rooms(("model",))
    module.write_text('"""Another."""\nx = 1  # a comment\n')
    assert reports.digest_of_rooms(("model",)) == before
    module.write_text('"""One."""\nx = 2\n')
    assert reports.digest_of_rooms(("model",)) != before


@pytest.mark.evidence
def test_every_report_is_of_the_rooms_as_they_stand():
    assert [report.name for report in reports.stale()] == []
