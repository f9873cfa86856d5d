"""What `predict` leaves against the recomputation from the timeline's JSON alone, on random specs of every kind.

`recompute.py` shares no code with the package: it is handed the text that
`gradcal check --timeline segments --json` prints. Twelve specs are part of every run, `-m evidence` takes two hundred
more.
"""

import ast
import copy
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import recompute
from random_specs import random_spec

from gradcal_jax.information.prediction import predict
from gradcal_jax.information.timeline import timeline
from gradcal_jax.spec import presets
from gradcal_jax.spec.motion_plan import PlanSchedule, row_count
from gradcal_jax.spec.spec import spec_of

TOLERANCE = 1e-9
# Quick ones, among them every family, both estimators, all bases, a lag, gaps, harmonics and two axes.
ALWAYS = {1, 6, 8, 11, 12, 14, 18, 19, 21, 22, 23, 24}


def timeline_text(spec) -> str:
    """As the command prints it."""
    return timeline(spec).model_dump_json(indent=2, exclude_none=True)


def difference(found, expected) -> float:
    """Largest relative difference; what cannot be observed must not be observed by either."""
    assert found.keys() == expected.keys()
    worst = 0.0
    for axis, values in expected.items():
        assert [v is None for v in found[axis]] == [v is None for v in values], axis
        pairs = zip(found[axis], values, strict=True)
        worst = max([worst, *(abs(a / b - 1.0) for a, b in pairs if b is not None)])
    return worst


@pytest.mark.parametrize(
    "seed", [pytest.param(k, marks=[] if k in ALWAYS else pytest.mark.evidence) for k in range(212)]
)
def test_a_program_that_has_the_timeline_alone_finds_the_same_standard_deviations(seed):
    spec = spec_of(random_spec(np.random.default_rng(seed)))
    expected = {"x": [p.std for p in predict(spec).parameters]}
    written = json.loads(timeline_text(spec))
    if isinstance(spec.schedule, PlanSchedule):
        assert len(written["readings"]) == row_count(spec.schedule, spec.rig.table)
    assert difference(recompute.sigmas(written), expected) < TOLERANCE


def test_shapes_in_the_place_of_priors_are_in_the_timeline():
    """A bias that varies in one shape, a scale factor in two, and little beyond: far from independent coefficients."""
    tables = tomllib.loads(presets.text("consumer-mems"))
    gyro = tables["sensor"]["gyro"]
    plain = [p.std for p in predict(spec_of(tables)).parameters]
    for key, shapes, unit in (
        ("bias", [[3.0, 2.0, 0.5, -0.5, -2.0, -3.0]], "dps"),
        ("scale_factor", [[900, 0, 0, 500, 0, 0, 20, 0, 1], [0, 300, 10, 0, 100, 0, 0, 4, 0]], "ppm"),
    ):
        gyro[key].pop("smoothness", None)
        del gyro[key]["prior"]
        rows = [*shapes, *(0.01 * np.eye(len(shapes[0]))).tolist()]
        gyro[key]["shape"] = [{"coefficients": [f"{x} {unit}" for x in row]} for row in rows]
    spec = spec_of(tables)
    expected = {"x": [p.std for p in predict(spec).parameters]}
    assert difference(recompute.sigmas(json.loads(timeline_text(spec))), expected) < TOLERANCE
    assert min(a / b for a, b in zip(next(iter(expected.values())), plain, strict=True)) < 0.2


def test_the_recomputation_shares_nothing_with_the_package():
    source = Path(recompute.__file__).read_text(encoding="utf-8")
    imported = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imported |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").split(".")[0])
    assert imported <= {*sys.stdlib_module_names, "numpy", "scipy"}


# One spec with everything that the contract says besides figures: a gap, offsets, every kind of start, priors.
EVERYTHING = {
    "format": "gradcal-spec/1",
    "sensor": {
        "thermal_lag": "90 s",
        "sample_clock_error": "20 ppm",
        "gyro": {
            "axes": ["x"],
            "angle_random_walk": "0.1 deg/sqrt(h)",
            "rate_random_walk": "5 deg/h/sqrt(h)",
            "turn_on_bias": "40 deg/h",
            "drift": [{"standard_deviation": "3 deg/h", "correlation_time": "120 s"}],
            "scale_factor_instability": [{"standard_deviation": "20 ppm", "correlation_time": "600 s"}],
            "temperature_error": {
                "standard_deviation": "0.1 K",
                "bias_slope": "5 deg/h/K",
                "scale_factor_slope": "9 ppm/K",
            },
            "bias_temperature_gradient": {"prior": "5 deg/h/(K/min)"},
            "bias": {
                "temperature": {"basis": "polynomial", "degree": 1, "scale": "50 K"},
                "prior": "50 deg/h",
                "discrepancy": {"standard_deviation": "2 deg/h", "temperature_degree": 2},
            },
            "scale_factor": {
                "temperature": {"basis": "bins", "edges": ["-10 degC", "15 degC", "50 degC"]},
                "rate": {"basis": "b-spline", "degree": 2, "knots": ["-300 deg/s", "20 deg/s", "300 deg/s"]},
                "prior": "5000 ppm",
                "smoothness": "200 ppm",
            },
        },
    },
    "rig": {
        "table": {
            "standing": "read",
            "mounting": [{"x": "+z", "y": "+x", "z": "+y"}],
            "axis": [
                {
                    "name": "x",
                    "direction": [0.0, 0.0, 1.0],
                    "max_rate": "300 deg/s",
                    "max_acceleration": "600 deg/s^2",
                    "angle": {
                        "read_every": "2 s",
                        "reading_noise": "5 arcsec",
                        "standstill_offset": "20 arcsec",
                        "timing_error": "1 ms",
                        "harmonics": [{"order": 1, "amplitude": "20 arcsec"}],
                    },
                }
            ],
        },
        "chamber": {"range": ["-40 degC", "85 degC"], "max_heating": "9 K/min", "max_cooling": "9 K/min"},
    },
    "plan": {
        "method": "gradient",
        "programme": [
            {"soak": "30 s", "at": "0 degC", "used": False},
            {"ramp_to": "12 degC", "rate": "9 K/min"},
            {"soak": "40 s"},
            {"ramp_to": "30 degC", "rate": "8 K/min"},
        ],
        "cycle": {
            "moves": [
                {"rest": "4 s", "read_every": "2 s"},
                {"peak_rate": "150 deg/s", "duration": "7 s", "shape": "linear ramps", "read_every": "3 s"},
                {"rest": "3 s", "read": "end"},
                {"turn": "-700 deg", "duration": "9 s", "shape": "cosine ramps"},
            ]
        },
    },
}


@pytest.fixture(scope="module")
def everything():
    """The timeline of that spec, as a program reads it, and what `predict` says."""
    spec = spec_of(EVERYTHING)
    return json.loads(timeline_text(spec)), {"x": [p.std for p in predict(spec).parameters]}


def channel(timeline):
    """The only one."""
    return timeline["channels"][0]


def term(timeline, name):
    """A map of the channel."""
    return next(of for of in channel(timeline)["terms"] if of["name"] == name)


def without(timeline, kind):
    """The timeline, short of an error of the installation."""
    timeline["installation"] = [row for row in timeline["installation"] if row["kind"] != kind]


def across_the_gap(timeline):
    """The first row behind the gap, as if the angle had been followed through it."""
    readings = timeline["readings"]
    k = next(k for k, r in enumerate(readings) if k and r["start"] > readings[k - 1]["time"] + 1e-6)
    readings[k]["start"] = readings[k - 1]["time"]


FAULTS = {
    "no origin after the gap": across_the_gap,
    "offset of another standstill": lambda t: t["readings"][1].update(standstill_ids=[1]),
    "no offset": lambda t: t["table"][0].update(standstill_offset=0.0),
    "timing": lambda t: t["table"][0].update(timing_error=0.0),
    "white noise": lambda t: t["table"][0].update(reading_noise=1.01 * t["table"][0]["reading_noise"]),
    "a reading": lambda t: t["readings"].pop(),
    "drift": lambda t: channel(t)["drift"][0].update(tau=121.0),
    "walk": lambda t: channel(t).update(rate_random_walk=0.0),
    "clock": lambda t: without(t, "sample_clock"),
    "temperature error": lambda t: channel(t)["temperature_error"].update(bias_slope=0.0),
    "instability": lambda t: channel(t).update(scale_factor_instability=[]),
    "turn-on bias": lambda t: channel(t).pop("turn_on_bias"),
    "lag": lambda t: t.update(thermal_lag=91.0),
    "functions of the prior": lambda t: term(t, "bias")["temperature"].update(centre=21.0),
    "smoothness": lambda t: term(t, "scale_factor").update(smoothness_along=["rate"]),
    "prior of dB/dT'": lambda t: channel(t)["bias_temperature_gradient"].pop("prior"),
    "discrepancy": lambda t: term(t, "bias").pop("discrepancy"),
    "harmonics": lambda t: without(t, "harmonics"),
    "shape": lambda t: next(s for s in t["segments"] if s["shape"] == "linear ramps").update(shape="cosine ramps"),
    "ramp": lambda t: next(s for s in t["segments"] if s["shape"] == "cosine ramps").update(ramp=0.5),
    "chamber": lambda t: t["segments"][2].update(temperature_end=t["segments"][2]["temperature_end"] + 0.01),
}


def test_all_that_the_contract_says_at_once(everything):
    written, expected = everything
    assert difference(recompute.sigmas(written), expected) < TOLERANCE


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_one_field_is_noticed(everything, fault):
    written, expected = everything
    broken = copy.deepcopy(written)
    FAULTS[fault](broken)
    assert broken != written
    assert difference(recompute.sigmas(broken), expected) > 1e3 * TOLERANCE


def test_the_points_of_one_run_share_the_clock():
    """A clock error of 1000 ppm common to the run stays: the paper's dynamic standard plan leaves 1005.4 ppm."""
    tables = tomllib.loads(presets.text("paper-dynamic-standard"))
    tables["sensor"] |= {"sample_clock_error": "1000 ppm", "clock": "sensor"}
    tables["plan"]["estimator"] = "best linear"
    written = json.loads(timeline_text(spec_of(tables)))
    assert written["points"] == "independent"
    apart = recompute.knowledge(written)["x"]
    together = recompute.knowledge({**written, "points": "one run"})["x"]
    t, w = np.linspace(-1.0, 1.0, 101), np.linspace(-1.0, 1.0, 121)
    functions = np.einsum("ti,wj->twij", t[:, None] ** np.arange(4), w[:, None] ** np.arange(4)).reshape(101, 121, 16)
    left = [float(np.mean(np.max(np.linalg.norm(functions @ k.root, axis=2), axis=0))) for k in (apart, together)]
    assert left[1] == pytest.approx(1005.4e-6, abs=0.05e-6)
    assert left[0] < 800e-6


def test_it_runs_as_a_program_of_its_own(everything, tmp_path):
    written, expected = everything
    path = tmp_path / "timeline.json"
    path.write_text(json.dumps(written), encoding="utf-8")
    # Isolated: neither this folder nor the package is on its path.
    command = [sys.executable, "-I", recompute.__file__, str(path)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert difference(json.loads(answer.stdout), expected) < TOLERANCE


def turning_point_by_a_break():
    """A rate that peaks at 94.136 deg/s, and a bin that begins just below."""
    tables = copy.deepcopy(EVERYTHING)
    tables["plan"]["cycle"]["moves"][1] = {
        "shape": "cosine ramps",
        "duration": "9 s",
        "ramp": "4.5 s",
        "peak_rate": "94.136 deg/s",
    }
    tables["sensor"]["gyro"]["scale_factor"]["rate"] = {
        "basis": "bins",
        "edges": ["-300 deg/s", "94.126 deg/s", "300 deg/s"],
    }
    return tables


def long_rest_behind_a_step():
    """A lag of 20 s that decays within 40 min from one reading to the next."""
    tables = copy.deepcopy(EVERYTHING)
    angle = tables["rig"]["table"]["axis"][0]["angle"]
    del tables["sensor"]["gyro"]["scale_factor"], angle["harmonics"]
    angle["read_every"] = "2000 s"
    tables["sensor"]["thermal_lag"] = "20 s"
    tables["sensor"]["gyro"]["bias"] = {
        "temperature": {"basis": "polynomial", "degree": 3, "scale": "20 K"},
        "prior": "50 deg/h",
    }
    tables["plan"] = {
        "method": "gradient",
        "programme": [
            {"soak": "60 s", "at": "0 degC"},
            {"step_to": "30 degC", "used": True},
            {"soak": "40 min", "used": True},
        ],
    }
    return tables


def by_hand():
    """Turns by hand, with the time that the operator needs beside them, and one typed angle in each rest."""
    tables = copy.deepcopy(EVERYTHING)
    tables["rig"]["table"] |= {"drive": "hand", "answer_time": "4 s"}
    turn = {"shape": "hand", "duration": "9 s", "unevenness": 0.3}
    rest = {"rest": "5 s", "read": "none"}
    tables["rig"]["table"]["axis"][0]["angle"]["read_every"] = "rest"
    tables["plan"]["cycle"]["moves"] = [rest, turn | {"turns": 1}, rest, turn | {"turn": "-500 deg"}]
    return tables


@pytest.mark.parametrize(
    "tables", [turning_point_by_a_break(), long_rest_behind_a_step(), by_hand()], ids=["turning", "lag", "by hand"]
)
def test_integrals_follow_every_turning_point_and_decay(tables):
    spec = spec_of(tables)
    expected = {"x": [p.std for p in predict(spec).parameters]}
    assert difference(recompute.sigmas(json.loads(timeline_text(spec))), expected) < TOLERANCE
