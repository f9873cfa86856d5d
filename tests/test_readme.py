"""What the README says is so: commands and options exist, and its numbers are what the program says."""

import re
from pathlib import Path

import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.cli.app import build

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def section(title):
    return README.split(f"## {title}\n", 1)[1].split("\n## ", 1)[0]


def rows(text):
    """Cells of a Markdown table's rows, head and rule left out."""
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def usages():
    """Every `gradcal …` of the README, in tables and in code blocks: its command and its options."""
    found = re.findall(r"`gradcal ([^`]+)`", README)
    found += [line.split("#")[0] for line in re.findall(r"^ {4}gradcal (.+)$", README, flags=re.M)]
    return sorted({(use.split()[0], option) for use in found for option in re.findall(r"(?<![\w-])--?[a-z-]+", use)})


@pytest.mark.parametrize(("command", "option"), usages())
def test_every_option_of_the_readme_exists(command, option, capsys):
    assert main([command, "--help"]) == 0
    assert re.search(rf"(?<![\w-]){option}(?![\w-])", capsys.readouterr().out)


def test_the_table_of_commands_is_whole():
    named = {re.match(r"`gradcal (\w+)", cell[0]).group(1) for cell in rows(section("Commands"))}
    assert named == {name for name in build() if not name.startswith("-")}


def test_the_two_commands_use_what_is_here():
    job, tests = (line.strip() for line in re.findall(r"^ {4}python3\.11 -m venv .*$", README, flags=re.M))
    for line in (job, tests):
        assert line.startswith("python3.11 -m venv .venv && .venv/bin/pip install -q -c constraints/py311.txt ")
    assert tests.endswith(".venv/bin/pytest -n 2")
    for version in ("311", "312", "313"):
        pins = (ROOT / "constraints" / f"py{version}.txt").read_text(encoding="utf-8").splitlines()
        assert all(re.fullmatch(r"#.*|[a-zA-Z0-9._-]+==[0-9][0-9a-zA-Z.]*", line) for line in pins)
    assert "gradcal predict gradcal_jax/files/presets/tactical-mems.toml" in job


def test_files_and_pictures_that_the_readme_names_are_here():
    linked = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(linked) >= 3
    for name in linked:
        assert (ROOT / name).is_file(), name
        assert (ROOT / name).stat().st_size < 300_000


@pytest.mark.parametrize("row", rows(section("A worked example: which table is good enough?")), ids=lambda row: row[0])
def test_the_worked_example_is_what_the_program_says(row):
    name, scale_factor, limits, bias = row
    found = gj.predict(gj.parse_spec(gj.presets.text(name)), limits=name == "rig-30arcsec")
    said = {
        r.name: f"{r.mean_of_max if r.quantity == 'scale_factor' else r.mean:.4g} {r.unit}" for r in found.requirements
    }
    assert said == {"scale factor": scale_factor, "bias": bias}
    if name == "rig-30arcsec":
        assert found.requirements[0].limited_by == limits


def test_the_known_answers_are_those_of_the_table():
    table = {tuple(row) for row in rows((ROOT / "experiments/paper/table.md").read_text(encoding="utf-8"))}
    known = rows(section("The paper, reproduced"))
    assert len(known) >= 8
    assert {tuple(row) for row in known} <= table
