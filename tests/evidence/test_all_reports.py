"""Reports of evidence are of today's program, or a proof says which are not."""

import importlib.util
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).parents[2] / "experiments" / "evidence" / "all.py"


def loaded(name: str):
    """A script beside the reports."""
    spec = importlib.util.spec_from_file_location(f"evidence_{name}", PATH.with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reports, mutations = loaded("all"), loaded("mutations")


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


def test_each_fault_by_hand_has_its_place_and_its_tests():
    assert mutations.without_place() == []
    root = PATH.parents[2]
    assert all((root / place.split("::")[0]).exists() for fault in mutations.FAULTS for place in fault.tests.split())
    assert len(mutations.FAULTS) >= 30


@pytest.mark.evidence
def test_every_report_is_of_the_rooms_as_they_stand():
    assert [report.name for report in reports.stale()] == []
