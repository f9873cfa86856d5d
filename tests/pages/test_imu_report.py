"""The page of an IMU's plan: its numbers are the prediction's, it says what is not observed, and nothing is fetched."""

import json
import re
from html import unescape
from math import comb
from types import SimpleNamespace

import numpy as np
import pytest
from report_samples import calibration_of_plan
from scipy.spatial.transform import Rotation

import gradcal_jax as gj
from gradcal_jax.calibration import FRAME_OF_CASE, Covariance, UnseenError
from gradcal_jax.cli import main
from gradcal_jax.estimation.calibrations import calibrated_posterior
from gradcal_jax.information import posterior
from gradcal_jax.information.imu_residual import imu_residual
from gradcal_jax.information.posterior import square_root
from gradcal_jax.model.imu_build import build_imu, imu_posterior
from gradcal_jax.pages.coefficients import agreement, coefficient_table, hidden_values, parameters
from gradcal_jax.pages.numbers import figures
from gradcal_jax.pages.sources import stated_figures
from gradcal_jax.spec import presets

# The paper's method at a coarser ramp: a third of the cycles.
SPEC = gj.changed(
    gj.parse_spec(presets.text("gradient-three-axes")),
    {"rig.chamber.max_heating": "3 K/min", "plan.gradient": "3 K/min"},
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    gj.write_toml(SPEC, folder / "imu.toml")
    data = gj.report(folder / "imu.toml", folder / "page.html")
    return data, (folder / "page.html").read_text(encoding="utf-8"), folder


@pytest.fixture(scope="module")
def found():
    """A plan's own covariance as a calibration, with the model and the posterior behind it."""
    built = build_imu(SPEC)
    return built, imu_posterior(built), calibration_of_plan(SPEC)


def test_every_number_is_the_prediction_s_and_every_warning_is_on_the_page(written):
    data, html, _ = written
    predicted = gj.predict(SPEC, limits=True)
    assert [row.predicted for row in data.requirements] == [row.judged for row in predicted.requirements]
    assert [row.verdict for row in data.requirements] == [row.verdict for row in predicted.requirements]
    assert [row.limited_by for row in data.requirements] == [row.limited_by for row in predicted.requirements]
    assert data.verdict == "missed"
    assert "Missed: a predicted residual exceeds its target" in html
    assert len(data.parameters) == len(predicted.parameters)
    bias = next(row for row in predicted.parameters if row.name == "accelerometer_x.a0")
    shown = next(row for row in data.parameters if (row.kind, row.name, row.axis) == ("accelerometer", "a0", "x"))
    assert shown.predicted_std == pytest.approx(bias.std / 9.80665e-6)
    assert shown.unit == "ug"
    for words in ("accelerometer z never points down: add a pose", 'turn "spin" by 180 deg', "k2"):
        assert words in unescape(html)
    for said in predicted.warnings:
        assert said in unescape(html)


def test_before_a_calibration_is_what_the_priors_leave(written):
    data, _, _ = written
    assert data.before_is == "without a calibration: the priors in the spec"
    before = {row.quantity: row.before for row in data.requirements}
    assert before["g_sensitivity"] == pytest.approx(50.0)
    assert before["second_order"] == pytest.approx(1000.0)
    # Two coefficients of 10 mrad, of 1 and of T′ on 101 temperatures of −1 … 1.
    at = np.linspace(-1.0, 1.0, 101)
    assert before["gyro_misalignment"] == pytest.approx(1e4 * np.mean(np.sqrt(1.0 + at**2)), rel=1e-9)
    assert all(row.before > row.predicted for row in data.requirements)


def test_every_element_of_a_requirement_is_drawn_and_the_page_fetches_nothing(written):
    data, html, _ = written
    elements = {
        name: {fact.axis for fact in data.maps if fact.name == name} for name in (r.name for r in data.requirements)
    }
    assert elements["gyro scale factor"] == elements["gyro bias"] == set("xyz")
    assert elements["gyro misalignment"] == {"xy", "xz", "yx", "yz", "zx", "zy"}
    assert len(elements["acceleration sensitivity"]) == 9
    # Of each gyro's scale factor the map before and as predicted, and their curves; of all else curves as predicted.
    assert html.count("<svg") == 3 * 3 + (len(SPEC.requirement) - 1) + 1
    assert 'id="poses"' in html
    assert "SIMULATED" not in html
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', html)
    assert "<script" not in html
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    assert "tilt of the base" in html
    assert "repeated 6 times" in html


def test_the_drawn_residuals_have_the_statistic_of_the_table(written):
    data, _, _ = written
    for row, requirement in zip(data.requirements, SPEC.requirement, strict=True):
        each = []
        for fact in (fact for fact in data.maps if fact.name == row.name):
            values = dict(fact.maps)["predicted"].values
            each.append(np.mean(np.max(values, axis=0)) if row.quantity == "gyro_scale_factor" else np.mean(values))
        together = np.sqrt(np.mean(np.square(each))) if requirement.axis == "all" else np.max(each)
        assert together == pytest.approx(row.predicted, rel=1e-9)


def test_another_plan_to_compare_with_and_the_command_prints_the_page_s_numbers(written, capsys, tmp_path):
    data, _, folder = written
    spec = str(folder / "imu.toml")
    assert main(["report", spec, spec, "-o", str(tmp_path / "no.html")]) == 2
    assert "second plan" in capsys.readouterr().err
    slower = gj.changed(SPEC, {"plan.gradient": "1.5 K/min"})
    gj.write_toml(slower, folder / "slower.toml")
    page = str(tmp_path / "page.html")
    assert main(["report", spec, "--before", str(folder / "slower.toml"), "-o", page, "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)
    assert tables["verdict"] == data.verdict
    assert [row["predicted"] for row in tables["requirements"]] == [row.predicted for row in data.requirements]
    others = gj.predict(slower).requirements
    assert [row["before"] for row in tables["requirements"]] == pytest.approx([row.judged for row in others], rel=1e-9)
    assert tables["before_is"].startswith("the plan in slower.toml")


def test_a_calibration_s_covariance_leaves_what_the_posterior_behind_it_does(found):
    built, known, calibration = found
    again = calibrated_posterior(built.model, calibration)
    for requirement in SPEC.requirement:
        expected, left = (imu_residual(built, of, requirement) for of in (known, again))
        assert left.labels == expected.labels
        np.testing.assert_allclose(left.values, expected.values, rtol=1e-6)


def test_what_no_residual_shows_counts_and_what_has_no_variance_is_not_observable(found):
    built, _, calibration = found
    of_bias = next(r for r in SPEC.requirement if r.quantity == "accelerometer_bias")
    plain = imu_residual(built, calibrated_posterior(built.model, calibration), of_bias)
    unseen = UnseenError(name="offset of the temperature", coefficients={"accelerometer_y.a0": 1e-3})
    more = calibration.model_copy(update={"unseen": (unseen,)})
    left = imu_residual(built, calibrated_posterior(built.model, more), of_bias)
    expected = plain.values.copy()
    expected[1] = np.hypot(expected[1], 1e-3 / 9.80665e-6)
    np.testing.assert_allclose(left.values, expected, rtol=1e-9)
    known = calibration.covariance
    gone = known.names.index("accelerometer_z.a1")
    rows = [k for k in range(len(known.names)) if k != gone]
    less = Covariance(
        names=tuple(known.names[k] for k in rows),
        matrix=tuple(tuple(known.matrix[k][i] for i in rows) for k in rows),
    )
    left = imu_residual(
        built, calibrated_posterior(built.model, calibration.model_copy(update={"covariance": less})), of_bias
    )
    at = np.linspace(-30.0, 70.0, left.values.shape[1])
    # a1 stands before T′, which is zero at 20 °C.
    assert np.isinf(left.values[2, np.abs(at - 20.0) > 1e-6]).all()
    np.testing.assert_allclose(left.values[:2], plain.values[:2], rtol=1e-9)


def test_a_few_channels_have_a_row_for_each_coefficient_and_many_a_column_for_each_axis(found):
    _, _, calibration = found
    hidden = hidden_values({"installation": {"tilt": 1.0}, "units": {"unit1": {"gyro_y.a0": 0.5}}}, calibration)
    facts = parameters(None, calibration, hidden)
    (head, *rows), _ = coefficient_table(facts)
    assert head == ("parameter ± 1σ (off by)", "x", "y", "z", "unit")
    row = next(row for row in rows if row[0] == "gyro a0")
    fact = next(fact for fact in facts if (fact.kind, fact.axis, fact.name) == ("gyro", "y", "a0"))
    assert fact.off_by_sigma == pytest.approx((fact.value - fact.truth) / fact.std)
    assert row[2].endswith(f"({figures(fact.off_by_sigma, 2)}σ)")
    assert "σ" not in row[1]
    (head, *rows), _ = coefficient_table([fact for fact in facts if fact.kind == "gyro"])
    assert "hidden truth" in head
    assert [row[0] for row in rows][:2] == ["gyro x: a0", "gyro x: a1"]


def test_the_figures_of_every_channel_and_axis_are_stated():
    stated = stated_figures(SPEC)
    for row in (
        ("angle random walk", "0.15 deg/√h"),
        ("velocity random walk", "0.05 m/s/√h"),
        ("accelerometer bias instability", "50 ug, correlation time 200 s"),
        ("tilt: reading noise", "5 arcsec"),
        ("spin: standstill offset", "5 arcsec"),
        ("tilt: angles between the table's axes", "100 urad"),
        ("azimuth of the base", "5 mrad"),
    ):
        assert row in stated


def test_the_prior_alone_hides_what_has_none():
    flat = gj.changed(SPEC, {"sensor.gyro.g_sensitivity": {}})
    built = build_imu(flat)
    prior = posterior(square_root(np.asarray(built.model.prior_rows())))
    by_name = {r.quantity: imu_residual(built, prior, r) for r in flat.requirement}
    assert np.isinf(by_name["g_sensitivity"].values).all()
    assert np.isfinite(by_name["gyro_bias"].values).all()


@pytest.mark.parametrize("mounted", [True, False])
def test_true_values_are_compared_in_the_frame_of_the_estimate(mounted):
    """A mounting that is a degree from the nominal one changes misalignments and scale factors to the second order."""
    rng = np.random.default_rng(5)
    names = [f"{kind}_{a}.m_{b}" for kind in ("gyro", "accelerometer") for a in "xyz" for b in "xyz" if a != b]
    truth = dict(zip(names, rng.normal(0.0, 0.02, 12), strict=True))
    truth |= {f"gyro_{a}.b00": 1e-3 for a in "xyz"} | {f"accelerometer_{a}.s0": -2e-3 for a in "xyz"}

    def seen(rotation):
        """What a sensor measures of vectors along the axes of a case that is turned."""
        turned, values = Rotation.from_rotvec(rotation).as_matrix(), {}
        for kind, size in (("gyro", "b00"), ("accelerometer", "s0")):
            for i, a in enumerate("xyz"):
                row = np.array([truth.get(f"{kind}_{a}.m_{b}", 1.0) for b in "xyz"]) @ turned
                values |= {f"{kind}_{a}.m_{b}": row[k] / row[i] for k, b in enumerate("xyz") if k != i}
                values[f"{kind}_{a}.{size}"] = (1.0 + truth[f"{kind}_{a}.{size}"]) * row[i] - 1.0
        return values

    values = seen([0.017, -0.012, 0.02])
    # The orientation of the case is known to a degree, and all else to 20 µrad.
    small = [seen(turn) for turn in 1e-6 * np.eye(3)]
    columns = [{n: 1.7e4 * (one[n] - truth[n]) for n in values} for one in small]
    unseen = [SimpleNamespace(coefficients=column) for column in columns]
    frame = FRAME_OF_CASE if mounted else "the table's axes"
    covariance = SimpleNamespace(names=tuple(values), matrix=(2e-5**2 * np.eye(len(values))).tolist())
    made = SimpleNamespace(covariance=covariance, unseen=unseen, values=lambda: values, frame=frame)
    chi_squared, degrees, chance = agreement(made, truth)
    if mounted:
        assert (degrees, chance) == (len(values) - 3, pytest.approx(1.0))
        assert chi_squared < 1e-3
    else:
        # The second order alone is many standard deviations.
        assert degrees == len(values)
        assert chi_squared > 100.0


def test_the_walk_of_a_bias_before_the_data_is_no_error_of_the_estimate():
    """The true bias is that of power-on: by the walk's variance on its diagonal."""
    names = ("gyro_x.a0", "gyro_x.a1")
    covariance = SimpleNamespace(names=names, matrix=[[1.0, 0.0], [0.0, 1.0]])
    made = SimpleNamespace(covariance=covariance, unseen=(), values=lambda: dict(zip(names, (5.0, 2.0), strict=True)))
    made.frame = "the table's axes"
    truth = dict.fromkeys(names, 0.0)
    assert agreement(made, truth)[0] == pytest.approx(25.0 + 4.0)
    assert agreement(made, truth, walked=2.0)[0] == pytest.approx(25.0 / 5.0 + 4.0)


def test_a_simulated_thermometer_that_is_off_shifts_the_maps_whole():
    """Of an offset of some kelvins the curvature counts: a cubic at the shown temperature is a cubic exactly."""
    names = tuple(f"gyro_x.a{k}" for k in range(4))
    truth = dict(zip(names, (1.0, 2.0, 3.0, 4.0), strict=True))
    # a(T' - 0.1), by the binomial.
    matrix = np.array([[comb(k, j) * (-0.1) ** (k - j) if k >= j else 0.0 for k in range(4)] for j in range(4)])
    values = dict(zip(names, (matrix @ list(truth.values())).tolist(), strict=True))
    basis = gj.parse_spec(presets.text("gradient-three-axes")).sensor.gyro.bias.temperature
    off = 0.1 * float(basis.scale)
    term = SimpleNamespace(temperature=basis, coefficients={f"a{k}": 0.0 for k in range(4)})
    channel = SimpleNamespace(kind="gyro", axis="x", valid_temperature=("-20", "60"), term=(term,))
    slope = UnseenError(name="offset of the temperature", coefficients={"gyro_x.a0": 1.0})
    made = SimpleNamespace(
        covariance=SimpleNamespace(names=names, matrix=(1e-6 * np.eye(4)).tolist()), unseen=(slope,),
        values=lambda: values, frame="the table's axes", channel=(channel,),
    )  # fmt: skip
    assert agreement(made, truth | {"temperature_offset": off})[0] < 1e-6
    # Else it is an error, of which the first order is counted.
    assert agreement(made, truth)[0] > 1e3
