"""What users do to programs: wrong arguments, wrong files, full disks, closed pipes, too little memory. No traceback.

Every case ends with a status of the program's and, where that is not success, with a sentence that begins "gradcal: ".
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main

PROGRAM = "import sys; from gradcal_jax.cli import main; sys.exit(main())"
GOOD = gj.presets.text("paper-static-gradient")
WHOLE = gj.presets.text("tactical-mems")
STATUSES = {0, 1, 2, 3, 130, 141}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Path("good.toml").write_text(GOOD, encoding="utf-8")
    Path("whole.toml").write_text(WHOLE, encoding="utf-8")
    Path("rig.toml").write_text(gj.presets.template("rig.toml"), encoding="utf-8")
    Path("empty.toml").write_bytes(b"")
    Path("empty.nc").write_bytes(b"")
    Path("data.csv").write_text("t,gx\n0,1\n1,2\n", encoding="utf-8")
    for name in ("folder.toml", "folder.nc", "begun"):
        Path(name).mkdir()
    Path("begun/run.json").write_text("{}", encoding="utf-8")
    return tmp_path


def judged(status, err):
    assert status in STATUSES
    assert "Traceback" not in err
    if status == 2:
        assert "gradcal: " in err
        assert len(err) < 4000


ARGUMENTS = """
nothing-known | --nonsense | predict | predict --json | predict good.toml extra.toml | predict good.toml --plot x.gif
predict good.toml --plot no/where.png | check | check --json | check good.toml --nope | start | start --list=x
start nothing -o x.toml | start tactical-mems | start tactical-mems -o good.toml | start tactical-mems -o no/where.toml
optimise good.toml | optimise whole.toml -o out.toml --steps 1 | optimise whole.toml -o good.toml | limit good.toml
optimise good.toml --steps 7 | rig | rig check | rig check good.toml | run | run good.toml -o run
run missing.toml --simulate -o run | run --resume nowhere | log nowhere
noise data.csv | noise data.csv --columns good.toml | noise missing.csv | noise empty.nc | noise data.csv --axis q
noise data.csv --rows 5 | noise data.csv --rows 9..1 | estimate | estimate data.csv | estimate empty.nc --spec good.toml
estimate missing.nc --spec good.toml | apply good.toml data.csv -o x.nc | apply missing.toml data.csv -o x.nc
validate good.toml data.csv | validate missing.toml empty.nc | export good.toml --format csv
export good.toml --format nothing | report | report -o x.html | report nowhere -o x.html | sweep good.toml -o x.nc
sweep missing.toml -o x.nc | sweep good.toml -o x.nc --workers 0 | demo -o good.toml | demo --seed x
"""
CASES = [case.strip() for line in ARGUMENTS.strip().splitlines() for case in line.split("|")]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("report -o x.html", "gradcal: SOURCES is missing\nSee gradcal report --help."),
        ("predict good.toml --plot", "gradcal: the value of --plot is missing\nSee gradcal predict --help."),
        ("rig chek", "See gradcal rig --help."),
        ("report good.toml -o x.pdf", "the name of a page must end in .html"),
    ],
)
def test_a_wrong_command_line_is_told_what_to_write(arguments, said, folder, capsys):
    assert main(arguments.split()) == 2
    assert said in capsys.readouterr().err
    assert not Path("x.pdf").exists()


@pytest.mark.parametrize("case", CASES)
def test_arguments(case, folder, capsys):
    judged(main(case.split()), capsys.readouterr().err)
    assert Path("good.toml").read_text(encoding="utf-8") == GOOD


BYTES = {
    "zeros": bytes(4096),
    "a byte order mark": b"\xef\xbb\xbf" + GOOD.encode(),
    "carriage returns": GOOD.replace("\n", "\r\n").encode(),
    "a NUL": GOOD.replace("[sensor]", "[sen\0sor]").encode(),
    "deep brackets": b"a = " + b"[" * 5000,
    "deep tables": b"[" + b".".join([b"a"] * 3000) + b"]",
    "many keys": b"\n".join(b"k%d = 1" % k for k in range(3000)),
    "a huge integer": GOOD.replace("degree = 3", "degree = " + "9" * 400).encode(),
}


@pytest.mark.parametrize("name", BYTES)
def test_bytes_of_a_file(name, folder, capsys):
    Path("given.toml").write_bytes(BYTES[name])
    status = main(["check", "--files-only", "given.toml"])
    judged(status, capsys.readouterr().err)
    assert (status == 0) == (name in ("a byte order mark", "carriage returns"))


MAP = """
format = "gradcal-columns/1"
name = "SN-1"
time = { column = "t", unit = "s" }
[rate]
x = { column = "gx", unit = "deg/s" }
"""
ROWS = "t,gx\n" + "".join(f"{k / 100:.2f},{0.01 * (k % 7):.4f}\n" for k in range(500))
SPEC, CSV = "given.toml", "given.csv"
CHECK, NOISE = "check --files-only given.toml", "noise given.csv --columns map.toml"
WRONG = {
    "a unit": (SPEC, GOOD.replace('"120 s"', '"120 sek"'), CHECK, "nearest: 'sec'"),
    "no unit": (SPEC, GOOD.replace('"120 s"', "120"), CHECK, 'such as "10 s"'),
    "nan in a spec": (SPEC, GOOD.replace("degree = 3", "degree = nan"), CHECK, "a whole number"),
    "a spec in UTF-16": (SPEC, GOOD.encode("utf-16"), CHECK, "not text in UTF-8"),
    "a folder": (SPEC, GOOD, "check folder.toml", "is a directory"),
    "semicolons": (CSV, ROWS.replace(",", ";"), NOISE, 'delimiter = ";"'),
    "nothing but nan": (CSV, "t,gx\n" + "".join(f"{k},nan\n" for k in range(500)), NOISE, "of 500 rows none is usable"),
    "words in a table": (CSV, ROWS.replace(",0.0100", ",none", 3), NOISE, "3 missing rate"),
    "a short table": (CSV, ROWS, NOISE, "use a shorter average, or a longer record"),
    "a spec for a calibration": (SPEC, GOOD, "export given.toml --format csv", 'expected "gradcal-calibration/3"'),
    "a file that exists": (SPEC, GOOD, "start tactical-mems -o given.toml", "overwrite it with --force"),
    "a folder that does not exist": (SPEC, GOOD, "start tactical-mems -o no/where.toml", "make it first"),
    "a file for a folder": (SPEC, GOOD, "start --preset drone-gyro -o given.toml", "name a directory"),
    "a command": (SPEC, GOOD, "chek given.toml", 'Did you mean "check"?'),
    "an option": (SPEC, GOOD, "check given.toml --files-onl", "--files-only"),
    "no name": (SPEC, GOOD, "check", "FILE"),
    "an example": (SPEC, GOOD, "start rig-hnd -o -", 'nearest: "rig-hand"'),
    "a file for a run": (SPEC, GOOD, "log given.toml", "given.toml is not the folder of a run"),
    "a folder for a recording": (SPEC, GOOD, "noise folder.nc", "folder.nc is a folder: name a recording"),
    "a run for a recording": (SPEC, GOOD, "noise begun", "begun is the folder of a run: name its log, begun/log.nc"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_is_one_sentence_with_its_remedy_and_nothing_is_written(name, folder, capsys):
    file, content, command, said = WRONG[name]
    Path("map.toml").write_text(MAP, encoding="utf-8")
    Path(file).write_bytes(content if isinstance(content, bytes) else content.encode())
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert main(command.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("gradcal: ")
    assert said in err
    assert err.count("\n") <= 2
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="rights of folders")
def test_a_folder_that_may_not_be_written_is_a_sentence(folder, capsys):
    folder.chmod(0o500)
    try:
        assert main(["start", "tactical-mems", "-o", "x.toml"]) == 2
    finally:
        folder.chmod(0o700)
    assert "x.toml: Permission denied" in capsys.readouterr().err


def run(program, folder, *arguments):
    words = [sys.executable, "-c", program, *arguments]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False, timeout=300)


# As on a disk that is full: no file grows beyond so many bytes. (A process with JAX in it forks none to be told so.)
SMALL_FILES = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100)); "


@pytest.mark.skipif(sys.platform == "win32", reason="limits of processes")
@pytest.mark.parametrize(
    "arguments",
    [
        ["start", "tactical-mems", "-o", "x.toml"],
        ["predict", "good.toml", "--plot", "x.png"],
    ],
    ids=" ".join,
)
def test_a_full_disk_leaves_nothing_half_written(arguments, folder):
    before = set(folder.iterdir())
    done = run(SMALL_FILES + PROGRAM, folder, *arguments)
    assert "Traceback" not in done.stderr
    assert done.returncode == 2
    # Caches that cannot be kept may be said before.
    assert done.stderr.splitlines()[-1] == f"gradcal: {arguments[-1]}: File too large"
    assert {path for path in folder.iterdir() if path.name != "cache"} == before


@pytest.mark.skipif(sys.platform == "win32", reason="limits of processes")
def test_a_log_on_a_full_disk_is_a_sentence_and_the_old_one_stays(folder):
    script = """
import numpy as np, sys
import gradcal_jax as gj
log = gj.Log(np.arange(5000.0), np.zeros((1, 5000, 1)), ("u",), ("x",))
gj.write_log(log, "log.nc")
before = open("log.nc", "rb").read()
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
try:
    gj.write_log(log, "log.nc")
except ValueError as error:
    print(error)
else:
    print("written")
assert open("log.nc", "rb").read() == before
"""
    done = run(script, folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "log.nc cannot be written" in done.stdout
    assert [path.name for path in folder.glob("*log*.nc*")] == ["log.nc"]


def closed_pipe() -> int:
    reading, writing = os.pipe()
    os.close(reading)
    return writing


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is full")
@pytest.mark.parametrize("arguments", [["--help"], ["check", "--files-only", "good.toml"]])
@pytest.mark.parametrize(
    ("opened", "status", "said"),
    [
        (lambda: os.open("/dev/full", os.O_WRONLY), 2, "No space left"),
        (closed_pipe, 141, ""),  # the reader has gone away
    ],
)
def test_output_that_nobody_gets_is_no_success(opened, status, said, arguments, folder):
    words = [sys.executable, "-c", PROGRAM, *arguments]
    with os.fdopen(opened(), "w") as stdout:
        done = subprocess.run(words, cwd=folder, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == status
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert bool(said) == bool(done.stderr)


@pytest.mark.parametrize("command", ["check", "predict"])
def test_a_plan_that_no_memory_holds_is_a_sentence_beforehand(command, folder, capsys):
    text = WHOLE.replace('rest = "5 s", read_every = "1 s"', 'rest = "5 s", read_every = "1.2e-5 s"')
    Path("big.toml").write_text(text, encoding="utf-8")
    status = main([command, "big.toml"])
    out, err = capsys.readouterr()
    judged(status, err)
    assert status in (1, 2)
    assert "memory" in out + err


def test_memory_that_ends_in_the_work_is_a_sentence(folder, capsys, monkeypatch):
    def nothing_left(*_, **__):
        raise MemoryError("Unable to allocate 7.45 TiB for an array")

    monkeypatch.setattr("gradcal_jax.information.prediction.build_imu", nothing_left)
    assert main(["predict", "good.toml"]) == 2
    assert capsys.readouterr().err.startswith("gradcal: out of memory (Unable to allocate 7.45 TiB for an array): ")
