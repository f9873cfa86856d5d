"""What README and docs say is so: commands and options exist, lines run, links lead somewhere, figures are right."""

import contextlib
import doctest
import importlib
import importlib.util
import inspect
import io
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.recipe.recipe import read_recipe

ROOT = Path(__file__).parents[1]
FILES = ["README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]
TEXTS = {name: (ROOT / name).read_text(encoding="utf-8") for name in FILES}
WRITTEN = TEXTS
README = TEXTS["README.md"]


def section(title, page="README.md"):
    return TEXTS[page].split(f"## {title}\n", 1)[1].split("\n## ", 1)[0]


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
    for text in WRITTEN.values():
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
    assert re.search(r"^gyro scale factor +mean of max +[\d.]+ ppm .* met$", capsys.readouterr().out, flags=re.M)


def test_the_page_of_notebooks_has_all_there_are():
    linked = set(re.findall(r"\(\.\./(notebooks/[^)]+)\)", TEXTS["docs/notebooks.md"]))
    assert linked == {f"notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")}


def test_the_class_of_one_s_own_in_the_how_to_predicts(capsys):
    (lines,) = re.findall(r"```python\n(.+?)```", TEXTS["docs/how-to/own-term.md"], flags=re.S)
    exec(compile(lines, "own-term.md", "exec"), {})
    assert capsys.readouterr().out.count("gyro_x.Magnetic") == 3


@pytest.mark.parametrize("module", sorted({*gj._HOME_OF_NAME.values(), "units.quantities", "spec.changes"}))
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


# -------------------------------------------------------------------------------------------------- what is shown runs

SMALL = {
    "sensor.gyro.scale_factor.temperature.degree": 1,
    "sensor.gyro.scale_factor.rate.degree": 1,
    "rig.table.axis[0].max_acceleration": "300 deg/s^2",
    "requirement": [
        {
            "name": "all rates",
            "quantity": "gyro_scale_factor",
            "temperature": ["20 degC", "26 degC"],
            "rate": ["-200 deg/s", "200 deg/s"],
            "grid": [11, 21],
            "target": "100000 ppm",
        }
    ],
    "plan.temperature": ["20 degC", "26 degC"],
    "plan.soak": {"duration": "60 s", "used": False},
    "plan.cycle.moves": [
        {"rest": "20 s", "read_every": "1 s"},
        {"turn": "1080 deg", "peak_rate": "150 deg/s", "shape": "cosine ramps"},
        {"rest": "20 s", "read_every": "1 s"},
        {"turn": "-1080 deg", "peak_rate": "60 deg/s", "shape": "cosine ramps"},
    ],
    "plan.cycle.other_axes": None,
    "design": {
        "minimise": "all rates",
        "free": ["duration", "peak_rate", "ramp"],
        "moves": 2,
        "starts": 2,
    },
}
"""A ramp of minutes, for which searches and runs are short."""
ELSEWHERE = {
    "run --resume run1": "tests/cli/test_run_cli.py",
    "optimise run1 -o rest.toml": "tests/hardware/test_imu_replanned.py",
    "run rest.toml --resume run1": "tests/hardware/test_imu_replanned.py",
    "allan bench.csv --columns columns.toml": "tests/cli/test_instability_cli.py",
    "allan rest.csv --columns columns.toml --format kalibr --output imu.yaml": (
        "tests/identify/test_noise_of_records.py"
    ),
    "estimate warm-up.ulg -o cal.toml --parameters tc.params": "tests/estimation/test_warm_up.py",
    "optimise imu.toml -o better.toml": "tests/design/test_pose_search.py",
    'estimate recording.npz --columns columns.toml --gravity "9.81744 m/s^2" --temperature "23 degC" -o imu.toml': (
        "tests/imu/test_hand_recording.py"
    ),
    "estimate run/log.nc --recipe recipe.toml -o calibration.toml --plot fit.png": (
        "tests/cli/test_imu_estimate_cli.py"
    ),
    "run recipe.toml --rig mine/rig.toml -o run1": "tests/cli/test_run_cli.py",
    "predict mine/spec.toml --sensitivity": "tests/cli/test_design_cli.py",
    "sweep experiments/sweeps/tactical_bench.toml -o results.nc --plot results.png": "tests/cli/test_sweep_cli.py",
}
"""Lines whose command another test runs, on less: they take minutes, or data that it makes."""
IN_PYTHON = {
    "optimise design.toml -o recipe.toml --steps 60": "gj.optimise(spec, steps=60)",
    "run recipe.toml --simulate -o run": 'gj.run(recipe, "run", simulate=True)',
    "run recipe.toml --simulate -o rehearsal": 'gj.run(recipe, "run", simulate=True)',
}
"""Lines that are one of Python's, which was run."""
SHORTER = {"predict my.toml --monte-carlo 500": "predict my.toml --monte-carlo 60"}
NO_DEVICE = {
    "rig check rig.toml",
    "rig check mine/rig.toml",
    "rig check rig.toml --recipe recipe.toml --move",
    "run recipe.toml --rig rig.toml -o run1",
    "run recipe.toml --rig mine/rig.toml -o monday",
}
"""Lines that want hardware: without it they say so, and end with status 3."""
PAGES = [page for page, text in WRITTEN.items() if lines_of(text)]


@pytest.fixture(scope="module")
def whole_job(tmp_path_factory):
    """A folder in which the lines of Python have done the whole job, and what they printed."""
    folder = tmp_path_factory.mktemp("job")
    (lines,) = re.findall(r"```python\n(.+?)```", TEXTS["docs/how-to/objective.md"], flags=re.S)
    gj.write_toml(gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), SMALL), folder / "design.toml")
    here = os.getcwd()
    os.chdir(folder)
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            exec(compile(lines, "objective.md", "exec"), {})
    finally:
        os.chdir(here)
    return folder, said.getvalue(), lines


def test_the_lines_of_python_do_the_whole_job(whole_job):
    folder, said, lines = whole_job
    assert 8 <= sum(1 for line in lines.splitlines() if "gj." in line) <= 10
    before, now, limit = (float(number) for number in re.findall(r"([\d.]+) ppm", said))
    made, found = read_recipe(folder / "run/recipe.toml"), gj.read_calibration(folder / "run/calibration.toml")
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert limit < now < 0.8 * before
    assert made.prediction.requirements[0].decisive == pytest.approx(now, rel=1e-9)
    assert made.optimisation is not None
    assert f"{now:.4g} ppm" in str(made)
    assert found.simulated
    assert found.provenance["recipe"] == made.fingerprint
    assert found.result[0].value == pytest.approx(now, rel=0.35)
    for value in (before, now, found.result[0].value):
        assert f"{value:.4g}\N{NO-BREAK SPACE}ppm" in page


@pytest.mark.parametrize("page", PAGES)
def test_every_line_of_a_page_runs(page, whole_job, tmp_path, monkeypatch):
    """In their order, in an empty folder; a run is the one of the lines of Python, not made again on every page."""
    job, _, python = whole_job
    monkeypatch.chdir(tmp_path)
    for name in ("experiments", "gradcal_jax"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/rig.toml").write_text(rig_of_the_certificate(), encoding="utf-8")
    shutil.copy(job / "design.toml", "design.toml")
    for line in lines_of(TEXTS[page]):
        if line in ELSEWHERE:
            assert f'"{line.split()[0]}"' in (ROOT / ELSEWHERE[line]).read_text(encoding="utf-8")
        elif line in IN_PYTHON:
            assert IN_PYTHON[line] in python
        else:
            prepared(line, job)
            ran(SHORTER.get(line, line))


def prepared(line, job):
    """What the line works on, where it is from a search or a run that the page does not show."""
    words = line.split()
    made = next((f for f in ("run1", "run", "rehearsal") if re.search(rf"\b{f}\b", line)), None)
    if words[0] == "log" and made:
        shutil.rmtree(made, ignore_errors=True)
    if words[0] in ("log", "estimate", "report") and made and not Path(made).exists():
        shutil.copytree(job / "run", made)
    if words[0] == "log":
        for name in ("log.nc", "calibration.toml"):
            Path(words[1], name).unlink(missing_ok=True)
    if words[0] in ("run", "limit") or words[:2] == ["check", "recipe.toml"]:
        shutil.copy(job / "run/recipe.toml", "recipe.toml")
    if "mine/spec.toml" in words:
        shutil.copy(job / "design.toml", "mine/spec.toml")


def ran(line):
    """Run a line; its status is as it should be, and its output where it belongs."""
    line, _, into = line.partition(" > ")
    shell = subprocess.run(["bash", "-c", f"printf '%s\\n' {line}"], capture_output=True, text=True, check=True)
    words = shell.stdout.splitlines()
    if words[0] == "start":
        words.append("--force")
    if words[0] == "run" and "--rig" in words and "--dry-run" not in words:
        # There is no terminal at which to confirm the list.
        words.append("--yes")
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        status = main(words)
    if line in NO_DEVICE:
        assert status == 3, line
    else:
        assert status == 0 or (status == 1 and words[0] in ("predict", "optimise", "estimate")), (line, said.getvalue())
    if into:
        Path(into).write_text(said.getvalue(), encoding="utf-8")


def rig_of_the_certificate():
    """A rig file with what the page shows."""
    shown = re.findall(r"(?:^ {4}.*\n)+", TEXTS["docs/how-to/certificate.md"], flags=re.M)[0]
    device = 'format = "gradcal-rig/1"\n[chamber]\ndriver = "espec"\nport = "/dev/no"\nsafe = "hold"\n'
    return device + re.sub(r"^ {4}", "", shown, flags=re.M)


def test_the_worked_example_is_what_the_program_says(monkeypatch, capsys):
    """The page's own line, with JSON in the place of the picture."""
    text = TEXTS["docs/how-to/table.md"]
    (line,) = re.findall(r"^ {4}gradcal (predict .+) --plot \S+$", text, flags=re.M)
    monkeypatch.chdir(ROOT)
    words = subprocess.run(["bash", "-c", f"echo {line}"], capture_output=True, text=True, check=True).stdout.split()
    assert main([*words, "--json"]) == 0
    told, found = rows(text), json.loads(capsys.readouterr().out)
    assert len(told) == len(found) == 3
    for (name, scale_factor, limits, alone), prediction in zip(told, found, strict=True):
        by_name = {row["name"]: row for row in prediction["requirements"]}
        assert prediction["title"] == gj.presets.title(name)
        assert f"{by_name['scale factor']['with_typical']:.4g} ppm" == scale_factor
        assert by_name["scale factor"]["limited_by"] == limits
        assert f"{by_name['scale factor']['mean_of_max']:.4g} ppm" == alone


def test_the_rig_file_of_the_certificate_is_read(tmp_path):
    (tmp_path / "rig.toml").write_text(rig_of_the_certificate(), encoding="utf-8")
    rig = gj.read_rig(tmp_path / "rig.toml")
    assert (rig.laboratory.country, rig.reference[0].device) == ("DE", "encoder")


def test_the_changelog_is_by_version_a_line_each_and_has_the_version_of_the_package():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## (.+)$", text, flags=re.M)
    assert versions[0] == "Unreleased"
    assert re.fullmatch(rf"{re.escape(gj.__version__)} – \d{{4}}-\d\d-\d\d", versions[1])
    assert set(re.findall(r"^### (.+)$", text, flags=re.M)) <= {"Added", "Changed", "Fixed", "Removed"}
    assert all(len(item) <= 260 for item in re.findall(r"^\* (.+(?:\n  .+)*)$", text, flags=re.M))
    assert f'\nversion = "{gj.__version__}"\n' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
