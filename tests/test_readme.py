"""What the README says is so: commands and options exist, and its numbers are what the program says."""

import json
import os
import re
import subprocess
import sys
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
    of = lambda use: " ".join(use.split()[: 2 if use.startswith(("rig ", "log turns")) else 1])  # noqa: E731
    return sorted({(of(use), option) for use in found for option in re.findall(r"(?<![\w-])--?[a-z-]+", use)})


@pytest.mark.parametrize(("command", "option"), usages())
def test_every_option_of_the_readme_exists(command, option, capsys):
    assert main([*command.split(), "--help"]) == 0
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
    assert job.endswith(".venv/bin/gradcal demo")


def test_files_and_pictures_that_the_readme_names_are_here():
    linked = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(linked) >= 3
    for name in linked:
        assert (ROOT / name).is_file(), name
        assert (ROOT / name).stat().st_size < 300_000


def test_the_worked_example_is_what_the_program_says(tmp_path):
    """The README's own line, run by a shell in a process of its own, with JSON in the place of the picture."""
    text = section("A worked example: which table is good enough?")
    (line,) = re.findall(r"^ {4}(gradcal compare .+) --plot \S+$", text, flags=re.M)
    environment = os.environ | {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "XDG_CACHE_HOME": str(tmp_path),
    }
    command = ["bash", "-c", f"{line} --json"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = rows(text)
    found = json.loads(done.stdout)
    assert len(told) == len(found) == 3
    for (name, scale_factor, limits, bias), prediction in zip(told, found, strict=True):
        by_name = {row["name"]: row for row in prediction["requirements"]}
        assert prediction["title"] == gj.presets.title(name)
        assert f"{by_name['scale factor']['mean_of_max']:.4g} ppm" == scale_factor
        assert by_name["scale factor"]["limited_by"] == limits
        assert f"{by_name['bias']['mean']:.4g} deg/h" == bias


def test_lines_that_begin_a_users_work_run_as_they_stand(tmp_path, monkeypatch, capsys):
    """Those of the code blocks that need no run and take no minute, in their order, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    lines = [line.split("#")[0].split() for line in re.findall(r"^ {4}gradcal (.+)$", README, flags=re.M)]
    quick = [words for words in lines if words[0] in ("new", "check") or words[:2] == ["rig", "new"]]
    assert len(quick) >= 4
    for words in quick:
        assert main(words) == 0, words
    assert {path.name for path in tmp_path.iterdir()} == {"paper.toml", "my.toml", "rig.toml", "unit.toml"}
    assert "the spec is sound" in capsys.readouterr().out


def test_notebooks_of_the_readme_are_all_there_are():
    linked = set(re.findall(r"\((notebooks/[^)]+)\)", README))
    assert linked == {f"notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")}


def test_the_known_answers_are_those_of_the_table():
    table = {tuple(row) for row in rows((ROOT / "experiments/paper/table.md").read_text(encoding="utf-8"))}
    known = rows(section("The paper, reproduced"))
    assert len(known) >= 8
    assert {tuple(row) for row in known} <= table
