"""What README and docs say is so: commands and options exist, lines run, links lead somewhere, figures are right."""

import doctest
import importlib
import importlib.util
import inspect
import os
import re
from pathlib import Path

import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main

ROOT = Path(__file__).parents[1]
FILES = ["README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]
TEXTS = {name: (ROOT / name).read_text(encoding="utf-8") for name in FILES}
README = TEXTS["README.md"]


def rows(text):
    """Cells of a Markdown table's rows, head and rule left out."""
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def lines_of(text):
    """Every `gradcal …` line of the code blocks, without its comment."""
    return [line.split(" #")[0].strip() for line in re.findall(r"^ {4}gradcal (.+)$", text, flags=re.M)]


def command_of(words):
    """Its command: one word, or two."""
    return " ".join(words[: 2 if words[0] == "rig" else 1])


# ------------------------------------------------------------------------------------------------------- what is said


def usages():
    """Every option that a page gives to a command, in text and in code blocks."""
    found = {}
    for text in TEXTS.values():
        for use in re.findall(r"`gradcal ([^`]+)`", text) + lines_of(text):
            words = use.split()
            options = re.findall(r"(?<![\w-])--?[a-z-]+", use)
            found.setdefault(command_of(words), set()).update(options)
    return found


@pytest.mark.parametrize("command", sorted(usages()))
def test_every_option_that_is_named_exists(command, capsys):
    assert main([*command.split(), "--help"]) == 0
    said = capsys.readouterr().out
    for option in usages()[command]:
        assert re.search(rf"(?<![\w-]){option}(?![\w-])", said), (command, option)


def test_every_command_that_a_message_names_exists(capsys):
    assert main(["--help"]) == 0
    known = set(re.findall(r"^  ([a-z]+): ", capsys.readouterr().out, flags=re.M)) - {"version"}
    assert len(known) >= 15
    for path in sorted((ROOT / "gradcal_jax").rglob("*.py")):
        for command in re.findall(r"[`\"'(; ]gradcal ([a-z]+)", path.read_text(encoding="utf-8")):
            assert command in known, (path.name, command)


def test_the_readme_is_a_screen_and_begins_with_what_is_simulated():
    assert len(README.split()) <= 450
    assert len(README.splitlines()) <= 60
    assert re.search(r"^!\[[^]]+\]\(experiments/\S+\.png\)$", README, flags=re.M)
    assert README.split("\n\n")[1].startswith("**Simulated, not yet run on hardware")


def test_the_two_commands_use_what_is_here():
    job, tests = (line.strip() for line in re.findall(r"^ {4}python3\.11 -m venv .*$", README, flags=re.M))
    for line in (job, tests):
        assert line.startswith("python3.11 -m venv .venv && .venv/bin/pip install -q -c constraints/py311.txt ")
    assert tests.endswith(".venv/bin/pytest -n 4")
    for version in ("311", "312", "313"):
        pins = (ROOT / "constraints" / f"py{version}.txt").read_text(encoding="utf-8").splitlines()
        assert all(re.fullmatch(r"#.*|[a-zA-Z0-9._-]+==[0-9][0-9a-zA-Z.]*", line) for line in pins)
    assert job.endswith(".venv/bin/gradcal demo")


def anchors(text):
    """The places that a link can lead to, as hosts of code make them of headings."""
    heads = re.findall(r"^#+ (.+)$", text, flags=re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.fixture(scope="module")
def reference():
    """The reference pages, which only a build of the site writes."""
    described = importlib.util.spec_from_file_location("reference_pages", ROOT / "docs/reference_pages.py")
    module = importlib.util.module_from_spec(described)
    described.loader.exec_module(module)
    return {f"docs/{path}": text for path, text in module.pages().items()}


def test_every_link_leads_somewhere(reference):
    """Links of the reference pages, too, and links to them."""
    for page, text in {**TEXTS, **reference}.items():
        for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", text):
            path = os.path.normpath(os.path.join(os.path.dirname(page), target)) if target else page
            assert path in reference or (ROOT / path).is_file(), (page, target)
            if anchor:
                led = reference.get(path) or (ROOT / path).read_text(encoding="utf-8")
                assert anchor in anchors(led), (page, target, anchor)


def test_every_key_has_a_meaning(reference):
    rows_of_keys = re.findall(r"^\| `(\w+)` \|.*\| ([^|]*) \|$", "\n".join(reference.values()), flags=re.M)
    assert len(rows_of_keys) > 200
    for key, meaning in rows_of_keys:
        assert re.match(r"[A-Z0-9\"\[].*\.$", meaning), key


def test_every_page_is_in_the_contents(reference):
    linked = {str(Path("docs") / t) for t in re.findall(r"\]\(([^)#\s]+)", TEXTS["docs/README.md"])}
    assert linked == {*FILES, *reference} - {"README.md", "docs/README.md"}


def test_the_lines_of_python_in_the_readme_print_a_prediction(tmp_path, monkeypatch, capsys):
    (lines,) = re.findall(r"```python\n(.+?)```", README, flags=re.S)
    monkeypatch.chdir(tmp_path)
    assert main(["start", "--preset", "drone-imu", "-o", "mine"]) == 0
    capsys.readouterr()
    exec(compile(lines, "README.md", "exec"), {})
    assert sum(1 for line in lines.splitlines() if line) == 4
    assert "gyro scale factor" in capsys.readouterr().out


def test_the_page_of_notebooks_has_all_there_are():
    linked = set(re.findall(r"\(\.\./(notebooks/[^)]+)\)", TEXTS["docs/notebooks.md"]))
    assert linked == {f"notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")}


def test_the_class_of_one_s_own_in_the_how_to_predicts(capsys):
    (lines,) = re.findall(r"```python\n(.+?)```", TEXTS["docs/how-to/own-term.md"], flags=re.S)
    exec(compile(lines, "own-term.md", "exec"), {})
    assert capsys.readouterr().out.count("gyro_x.magnetic") == 3


@pytest.mark.parametrize("module", sorted({*gj._HOME_OF_NAME.values(), "units", "spec.changes"}))
def test_the_examples_of_docstrings_are_right(module):
    # (A package's own names are those of its modules.)
    names = [name for name, home in gj._HOME_OF_NAME.items() if home == module]
    held = [importlib.import_module(f"gradcal_jax.{module}"), *(inspect.getmodule(getattr(gj, name)) for name in names)]
    for one in {id(part): part for part in held if part is not None}.values():
        failed, _ = doctest.testmod(one, optionflags=doctest.NORMALIZE_WHITESPACE)
        assert failed == 0, one


def test_the_known_answers_are_those_of_the_table():
    table = {tuple(row) for row in rows((ROOT / "experiments/paper/table.md").read_text(encoding="utf-8"))}
    known = rows(TEXTS["docs/explanation/paper.md"])
    assert len(known) >= 8
    assert {tuple(row) for row in known} <= table


def test_the_changelog_has_the_version_of_the_package():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (version,) = re.findall(r"^## (.+)$", text, flags=re.M)
    assert re.fullmatch(rf"{re.escape(gj.__version__)} – \d{{4}}-\d\d-\d\d", version)
    assert f'\nversion = "{gj.__version__}"\n' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f"version: {gj.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
