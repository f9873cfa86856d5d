"""`gradcal optimise`, `limit`, `frontier` and `sensitivity` as a user calls them, Ctrl-C and going on included."""

import json
import re
import signal
import subprocess
import sys

import pytest
from search_problem import SPEC

from gradcal_jax.cli import main
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.writing import write_toml

# Two noises make the whole residual; turns are slow, so that there is much to gain, and the cable ends.
CHANGES = {
    "sensor.drift": None,
    "rig.table.travel": "7200 deg",
    "requirement[0].target": "200 ppm",
    "requirement[0].grid": [11, 11],
    "plan.cycle.moves[1].peak_rate": "20 deg/s",
    "plan.cycle.moves[3].peak_rate": "-20 deg/s",
    "design.free": ["duration", "peak_rate"],
}
# Who starts the tests in the background of a shell has them ignore interrupts: undone first.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from gradcal_jax.cli import main
sys.exit(main())
"""
GRADCAL = [sys.executable, "-c", PROGRAM]
STEPS = ["--steps", "80"]
SEARCH = [*GRADCAL, "optimise", "spec.toml", *STEPS, "--json", "-o"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("design")
    write_toml(changed(parse_spec(SPEC), CHANGES), found / "spec.toml")
    return found


@pytest.fixture(scope="module")
def interrupted(folder):
    """A search that Ctrl-C ends early: its JSON, after what was shown has been looked at."""
    with subprocess.Popen(
        [*SEARCH, "part.toml"], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as search:
        assert search.stderr is not None
        shown = [search.stderr.readline() for _ in range(2)]
        search.send_signal(signal.SIGINT)
        said, complaint = search.communicate(timeout=300)
    assert all(re.match(r" *\d+%  full range \(mean of max\): \S+ -> \S+ ppm", line) for line in shown), shown
    assert search.returncode == 130, complaint
    assert "--resume" in complaint
    assert "\x1b" not in said + complaint
    return json.loads(said)


@pytest.fixture(scope="module")
def resumed(folder, interrupted):
    """The same search gone on to its end: its JSON."""
    assert (folder / "part.toml.search.npz").exists()
    done = subprocess.run([*SEARCH, "part.toml", "--resume"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert not (folder / "part.toml.search.npz").exists()
    return json.loads(done.stdout)


@pytest.mark.long
def test_an_interrupted_search_keeps_the_best_and_goes_on(interrupted, resumed):
    assert "interrupted; the best plan so far" in interrupted["status"]
    assert resumed["now"] <= interrupted["now"] * 1.01
    assert resumed["now"] < resumed["before"] == interrupted["before"]


@pytest.mark.evidence
def test_it_ends_where_an_uninterrupted_one_does(folder, resumed):
    done = subprocess.run([*SEARCH, "whole.toml"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert json.loads(done.stdout)["now"] == resumed["now"]
    assert (folder / "part.toml").read_text() == (folder / "whole.toml").read_text()


@pytest.mark.long
def test_the_recipe_carries_what_is_said_and_predict_says_the_same(resumed, folder, capsys):
    recipe = str(folder / "part.toml")
    # The spec names little: with what it leaves out no plan is within 200 ppm.
    assert main(["predict", recipe, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["requirements"][0]["mean_of_max"] == pytest.approx(resumed["now"])
    assert main(["limit", recipe, "--json"]) == 0
    row = json.loads(capsys.readouterr().out)[0]
    assert row["certified"] <= row["reached"] * (1 + 1e-9)
    assert row["certified"] < resumed["now"] == pytest.approx(row["value"])
    # It is not written over by mistake.
    assert main(["optimise", str(folder / "spec.toml"), "-o", recipe]) == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.evidence
def test_a_frontier_falls_and_says_the_shortest(folder, capsys):
    picture = folder / "frontier.png"
    command = ["optimise", str(folder / "spec.toml"), "--motion", "50min,200min", *STEPS, "--json"]
    assert main([*command, "--plot", str(picture), "-o", str(folder / "plans")]) in (0, 1)
    found = json.loads(capsys.readouterr().out)
    short, long = found["points"]
    assert (short["motion_s"], long["motion_s"]) == (3000.0, 12000.0)
    assert long["residual"] < short["residual"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in (folder / "plans").iterdir()) == ["200min.toml", "50min.toml"]
    times = found["shortest_s"]["full range"]
    assert times is None if long["residual"] > 200.0 else 3000.0 <= times <= 12000.0


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        ("5min..4min", "must be longer than the first"),
        ("0min..4min", "is not a duration"),
        ("1h..2h..3h", "expected a range"),
    ],
)
def test_durations_that_are_none_are_refused(folder, capsys, motion, says):
    assert main(["optimise", str(folder / "spec.toml"), "--motion", motion]) == 2
    assert says in capsys.readouterr().err


def test_sensitivities_are_sorted_and_add_up_to_one_for_all_noise(folder, capsys):
    """The residual is of degree one in all standard deviations together."""
    assert main(["predict", str(folder / "spec.toml"), "--sensitivity", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["percent_per_percent"]
    changes = [row["percent"] for row in rows]
    assert changes == sorted(changes, key=abs, reverse=True)
    noise = [row["percent"] for row in rows if "walk" in row["figure"] or "reading" in row["figure"]]
    assert len(noise) == 2, rows
    assert sum(noise) == pytest.approx(1.0, abs=0.02)
