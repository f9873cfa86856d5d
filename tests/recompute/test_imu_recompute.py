"""gradcal-timeline/3 is enough: attitudes from the angles, and sigmas by dense generalised least squares."""

import json

import jsonschema
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gradcal_jax as gj
from gradcal_jax.spec import presets
from gradcal_jax.tables.schemas import schema

PLANS = ("accelerometer-six-positions", "ferraris", "one-axis-table", "standard-three-axes")
SKEW = {"rig.table.mounting": [{"rotation": ["20 deg", "-35 deg", "50 deg"]}]}


def spec_of(name, changes=None):
    spec = gj.parse_spec(presets.text(name), name)
    return gj.changed(spec, changes) if changes else spec


@pytest.fixture(scope="module")
def documents():
    """The timelines as other programs read them."""
    found = {name: gj.timeline(spec_of(name)) for name in PLANS}
    found["skew"] = gj.timeline(spec_of("ferraris", SKEW))
    return {name: json.loads(timeline.model_dump_json(exclude_none=True)) for name, timeline in found.items()}


def stages(document, angles, mounting):
    """Attitude, and what each axis and each cross direction is, seen from the body."""
    inner = Rotation.from_matrix(document["mountings"][mounting]["rotation"])
    directions = [np.array(axis["direction"]) for axis in document["table"]]
    axes, crosses = [], []
    for k in reversed(range(len(directions))):
        axes.insert(0, inner.inv().apply(directions[k]))
        if k + 1 < len(directions):
            crosses.insert(0, inner.inv().apply(np.cross(directions[k + 1], directions[k])))
        inner = Rotation.from_rotvec(angles[k] * directions[k]) * inner
    return inner.as_matrix(), axes, crosses


@pytest.mark.parametrize("name", [*PLANS, "skew"])
def test_a_timeline_of_a_unit_is_valid_and_its_attitudes_follow_from_its_angles(documents, name):
    document = documents[name]
    jsonschema.Draft202012Validator(schema("timeline")).validate(document)
    names = [axis["name"] for axis in document["table"]]
    clock, before, stands = 0.0, document["segments"][0]["angles_before"], [0] * len(names)
    rows = {(r["start"], r["time"]): r["channels"] for r in document["readings"]}
    for s in document["segments"]:
        assert s["start"] == pytest.approx(clock, abs=1e-6)
        assert s["angles_before"] == pytest.approx(before, abs=1e-9)
        attitude, _, _ = stages(document, s["angles_before"], s["mounting"])
        assert s["attitude"] == pytest.approx(attitude, abs=1e-12)
        turned = np.subtract(s["angles_after"], s["angles_before"])
        expected = [s["angle"] if n == s.get("axis") else 0.0 for n in names]
        assert turned == pytest.approx(expected, abs=1e-9)
        stands = [n + (a == s.get("axis")) for n, a in zip(stands, names, strict=True)]
        moving = [None if a == s.get("axis") else n for n, a in zip(stands, names, strict=True)]
        assert s["standstill_ids"] == moving
        if s["used"]:
            read = [c["name"] for c in document["channels"] if c["kind"] == "gyro" or "axis" not in s]
            row = rows.pop((s["start"], s["start"] + s["duration"]), [])
            assert row == read
        clock, before = s["start"] + s["duration"], s["angles_after"]
    assert not rows
    assert clock == pytest.approx(spec_of("ferraris" if name == "skew" else name).schedule.duration, rel=1e-9)


def test_each_mounting_has_its_ramp_and_the_chamber_is_where_the_plan_has_it(documents):
    used = [s for s in documents["one-axis-table"]["segments"] if s["used"]]
    assert sorted({s["mounting"] for s in used}) == [0, 1, 2]
    for k in range(3):
        part = [s for s in used if s["mounting"] == k]
        assert part[0]["temperature_start"] == pytest.approx(-30.0, abs=1e-6)
        assert part[-1]["temperature_end"] == pytest.approx(70.0, abs=1e-6)
    held = [s for s in documents["standard-three-axes"]["segments"] if s["used"]]
    assert sorted({s["temperature_start"] for s in held}) == pytest.approx([-30.0, -5.0, 20.0, 45.0, 70.0])


def test_other_programs_can_compute_every_sigma_of_accelerometers_from_the_timeline(documents):
    """Dense generalised least squares from the JSON alone: closed integrals of the drift, no filter, no table code."""
    document = documents["accelerometer-six-positions"]
    g, channels = document["site"]["gravity"], document["channels"]
    rows_at = {r["start"] for r in document["readings"]}
    rests = [s for s in document["segments"] if s["start"] in rows_at]
    names = [p for c in channels for t in c["terms"] for p in t["parameters"]]
    priors = [t["prior"] for c in channels for t in c["terms"] for _ in t["parameters"]]
    installed = document["installation"]
    names += [p for row in installed for p in row["parameters"]]
    priors += [std for row in installed for std in row["stds"]]
    rows, encoders, where = [], [], []
    for s in rests:
        attitude, axes, crosses = stages(document, s["angles_before"], s["mounting"])
        force, lasting = g * attitude[2], s["duration"]
        shared = []
        for row in installed:
            if row["kind"] == "base":
                shared += [np.cross(force, p) for p in attitude]
            elif row["kind"] == "orthogonality":
                shared += [np.cross(force, p) for p in crosses]
            elif row["kind"] == "gravity":
                shared.append(attitude[2])
            elif row["kind"] == "harmonics":
                k = [axis["name"] for axis in document["table"]].index(row["axis"])
                for order in row["orders"]:
                    shared += [
                        np.cross(force, axes[k]) * wave(order * s["angles_before"][k]) for wave in (np.cos, np.sin)
                    ]
            else:
                raise AssertionError(row["kind"])
        for i, c in enumerate(channels):
            own = []
            for other, term in ((o, t) for o in channels for t in o["terms"]):
                signals = [force["xyz".index(name[-1])] for name in term["signals"]]
                own.append(float(np.prod(signals)) if other is c else 0.0)
            rows.append(lasting * np.array([*own, *(v[i] for v in shared)]))
            encoders.append([lasting * np.cross(force, a)[i] for a in axes])
            where.append((s, i))
    count = len(rows)
    noise = np.zeros((count, count))
    for a, (s, i) in enumerate(where):
        for b, (t, j) in enumerate(where):
            if i == j:
                if a == b:
                    noise[a, b] += channels[i]["white"] ** 2 * s["duration"]
                for process in channels[i]["drift"]:
                    noise[a, b] += process["sigma"] ** 2 * both(s, t, process["tau"])
            for k, axis in enumerate(document["table"]):
                if s["standstill_ids"][k] == t["standstill_ids"][k]:
                    noise[a, b] += encoders[a][k] * encoders[b][k] * variance(document, axis, k, s["standstill_ids"][k])
    design = np.array(rows)
    information = design.T @ np.linalg.solve(noise, design) + np.diag(1.0 / np.array(priors) ** 2)
    sigmas = dict(zip(names, np.sqrt(np.diag(np.linalg.inv(information))), strict=True))
    predicted = gj.predict(spec_of("accelerometer-six-positions")).parameters
    assert len(predicted) == 15
    for row in predicted:
        assert row.std == pytest.approx(sigmas[row.name], rel=1e-7), row.name


def variance(document, axis, k, stands):
    """Of one axis's encoder error in one standstill: an offset, and readings at its beginning and ever after."""
    inside = [s for s in document["segments"] if s["standstill_ids"][k] == stands]
    lasting = inside[-1]["start"] + inside[-1]["duration"] - inside[0]["start"]
    readings = np.floor(lasting / axis["read_every"] + 1e-9) + 1.0
    return axis["standstill_offset"] ** 2 + axis["reading_noise"] ** 2 / readings


def both(s, t, tau):
    """∫∫exp(−|u − v|/τ) du dv over two segments."""
    if s["start"] == t["start"]:
        d = s["duration"]
        return 2.0 * tau * (d - tau * -np.expm1(-d / tau))
    first, second = (s, t) if s["start"] < t["start"] else (t, s)
    gap = second["start"] - first["start"] - first["duration"]
    a, b = first["duration"], second["duration"]
    return tau**2 * np.exp(-gap / tau) * np.expm1(-a / tau) * np.expm1(-b / tau)
