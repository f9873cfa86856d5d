"""Pages against what they are made of: every number of a page is one of its recipe, run or calibration."""

import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from report_samples import calibration, recipe, rehearse, spec

from gradcal_jax.calibration import write_calibration
from gradcal_jax.calibration.correction import channel_error
from gradcal_jax.cli import main
from gradcal_jax.estimation.calibrations import calibration_map, standard_terms
from gradcal_jax.information import statistic
from gradcal_jax.pages.figures import map_pictures
from gradcal_jax.pages.numbers import figures, one_sign, with_uncertainty
from gradcal_jax.pages.page import page
from gradcal_jax.pages.report_data import as_tables, report_data_of
from gradcal_jax.pages.run_history import history_of, rates_of
from gradcal_jax.pages.sources import read_sources
from gradcal_jax.plots import draw_curves
from gradcal_jax.plots.spec import planned_cycle, planned_rate
from gradcal_jax.tables.writing import to_toml, write_toml

DEG_PER_H = float(np.degrees(1.0)) * 3600.0


class Page(HTMLParser):
    """Rows of every table by section, ids, and the text that a reader sees."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.rows: dict[str, list[dict[str, str]]] = {}
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self._section, self._cell, self._quiet = "", "", False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append(tag)
        if given.get("id"):
            self.ids.append(str(given["id"]))
        if tag == "section":
            self._section = str(given["id"])
        elif tag == "tr":
            self.rows.setdefault(self._section, []).append({})
        elif tag == "td":
            self._cell = str(given["data-label"])
            self.rows[self._section][-1][self._cell] = ""
        self._quiet = tag == "style"

    def handle_endtag(self, tag: str) -> None:
        if tag == "td":
            self._cell = ""

    def handle_data(self, data: str) -> None:
        if not self._quiet:
            self.text += data
        if self._cell:
            self.rows[self._section][-1][self._cell] += data

    def table(self, section: str, first: str) -> list[dict[str, str]]:
        """Rows of a section whose first column has a name."""
        return [row for row in self.rows.get(section, []) if row and next(iter(row)) == first]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with recipe, run and calibration, the recipe itself, the calibration, the truth."""
    folder = tmp_path_factory.mktemp("report")
    plan = recipe()
    write_toml(plan, folder / "recipe.toml")
    truth = rehearse(plan, folder / "run")
    found = calibration(plan)
    write_calibration(found, folder / "run" / "calibration.toml")
    return folder, plan, found, truth


@pytest.fixture(scope="module")
def whole(made):
    """ReportData and the page of the run."""
    sources = read_sources([made[0] / "run"])
    data = report_data_of(sources)
    return data, Page(page(sources, data)), page(sources, data)


def number(text: str) -> float:
    return float(text.replace("−", "-").split("\N{NO-BREAK SPACE}")[0].split()[0])


def test_the_requirements_of_a_page_are_those_of_recipe_and_calibration(made, whole):
    _, plan, found, _ = made
    data, shown, _ = whole
    rows = shown.table("requirements", "requirement")
    assert [row["requirement"].split(" (")[0] for row in rows] == ["all rates", "slow", "at rest"]
    for row, fact, predicted in zip(rows, data.requirements, plan.prediction.requirements, strict=True):
        assert fact.predicted == predicted.judged
        assert row["predicted"] == f"{figures(predicted.judged)}\N{NO-BREAK SPACE}{predicted.unit}"
        assert row["statistic"] == predicted.statistic
        assert row["limited by"] == predicted.limited_by
    assert data.requirements[0].achieved == found.result[0].value
    assert rows[0]["achieved"] == "123.5\N{NO-BREAK SPACE}ppm"
    assert rows[1]["achieved"] == ""
    assert (rows[0]["verdict"], number(rows[0]["target"])) == ("met", 2000.0)
    assert "Met: every target" in shown.text
    # The drawn results are not those of the drawn covariance, as with a model discrepancy; the page says so.
    assert any("achieved maps use the covariance" in note and "123.5 ppm in the table" in note for note in data.notes)


def test_predicted_maps_have_the_recipes_statistics_and_achieved_ones_the_covariances(made, whole):
    _, plan, found, _ = made
    for fact, predicted, requirement in zip(
        whole[0].maps, plan.prediction.requirements, plan.spec.requirement, strict=True
    ):
        maps = dict(fact.maps)
        assert statistic(requirement.statistic, maps["predicted"].values) == pytest.approx(predicted.judged, rel=1e-9)
        # Coefficients of degree one, each as uncertain as its prior.
        cold, fast = (maps["before"].temperature_c - 20.0) / 50.0, maps["before"].rate_dps / 300.0
        expected = np.sqrt(np.outer(1.0 + cold**2, 1.0 + fast**2 if len(fast) > 1 else np.ones(1)))
        prior = 5000.0 if len(fast) > 1 else 200.0
        np.testing.assert_allclose(maps["before"].values, prior * expected, rtol=1e-9)
    # One point by hand: ψ of the monomials, the file's covariance between.
    maps = dict(whole[0].maps[0].maps)
    box = maps["achieved"]
    cold, fast = (box.temperature_c[2] - 20.0) / 50.0, np.radians(box.rate_dps[3]) / np.radians(300.0)
    psi = np.array([0.0, 0.0, 1.0, fast, cold, cold * fast])
    assert [n[7:] for n in found.covariance.names] == ["a0", "a1", "b00", "b10", "b01", "b11"]
    expected = 1e6 * np.sqrt(psi @ np.array(found.covariance.matrix) @ psi)
    assert box.values[2, 3] == pytest.approx(expected, rel=1e-12)


def test_parameters_and_their_hidden_truth_are_those_of_the_files(made, whole):
    _, plan, found, truth = made
    rows = whole[1].table("parameters", "parameter")
    values = {name.removeprefix("gyro_x."): value for name, value in found.values().items()}
    predicted = {row.name.removeprefix("gyro_x."): row.std for row in plan.prediction.parameters}
    truth = {name.removeprefix("gyro_x."): value for name, value in truth["units"]["unit1"].items()}
    assert [row["parameter"] for row in rows] == list(values)
    deviations = np.sqrt(np.diag(np.array(found.covariance.matrix)))
    for row, std in zip(rows, deviations, strict=True):
        name = row["parameter"]
        factor = DEG_PER_H if name.startswith("a") else 1e6
        assert row["unit"] == ("deg/h" if name.startswith("a") else "ppm")
        assert number(row["value"]) == pytest.approx(values[name] * factor, rel=1e-5)
        assert number(row["1σ"]) == pytest.approx(std * factor, rel=1e-3)
        assert number(row["1σ predicted"]) == pytest.approx(predicted[name] * factor, rel=1e-3)
        assert number(row["hidden truth"]) == pytest.approx(truth[name] * factor, rel=1e-5)
        assert number(row["off by"]) == pytest.approx((values[name] - truth[name]) / std, rel=0.05)
    assert [row["multiplies"] for row in rows] == ["1", "T′", "1", "ω′", "T′", "ω′·T′"]


def test_the_standards_terms_are_those_of_a_map_that_is_known(made):
    found = made[2]
    known = {name.removeprefix("gyro_x."): value for name, value in found.values().items()}
    terms = {term.name: term for term in standard_terms(found, found.channel[0])}
    step, variance = 5.0 / 50.0, np.array(found.covariance.matrix)
    bias = np.array([1.0, step])
    assert terms["bias"].value == pytest.approx((known["a0"] + known["a1"] * step) * DEG_PER_H)
    assert terms["bias"].std == pytest.approx(np.sqrt(bias @ variance[:2, :2] @ bias) * DEG_PER_H)
    assert terms["bias temperature sensitivity"].value == pytest.approx(known["a1"] / 50.0 * DEG_PER_H)
    odd = known["b10"] + known["b11"] * step
    assert terms["scale factor error"].value == pytest.approx(1e6 * (known["b00"] + known["b01"] * step))
    rates = np.linspace(-200.0, 200.0, 121)
    assert terms["scale factor asymmetry"].value == pytest.approx(1e6 * odd * 2.0 * rates[rates > 0].mean() / 300.0)
    # M·ω has the parabola odd·ω²/300; over ±200 its distance from the best line is largest at the ends.
    parabola = odd / 300.0 * (rates**2 - np.mean(rates**2)) / 200.0
    assert abs(terms["scale factor nonlinearity"].value) == pytest.approx(1e6 * np.abs(parabola).max())
    assert terms["scale factor temperature sensitivity"].value == pytest.approx(1e6 * known["b01"] / 50.0)


def test_what_the_data_do_not_tell_is_not_a_number(made):
    known = made[2].covariance
    covariance = known.model_copy(
        update={"names": known.names[:-1], "matrix": tuple(row[:-1] for row in known.matrix[:-1])}
    )
    less = made[2].model_copy(update={"covariance": covariance})
    channel = less.channel[0]
    _, deviation = calibration_map(
        less, channel, "scale_factor", np.array([20.0, 25.0]), np.array([-100.0, 0.0, 100.0])
    )
    # b11 stands before ω′·T′, which is zero at 20 °C and at rest.
    assert np.isfinite(deviation.values).tolist() == [[True, True, True], [False, True, False]]
    assert {term.name: term.std for term in standard_terms(less, channel)}["scale factor asymmetry"] is None


def test_the_run_is_the_journals(made, whole):
    folder, plan, _, _ = made
    history = history_of(read_sources([folder / "run"]).run)
    assert (history.status, history.sessions, history.simulated, history.verified_safe) == ("success", 1, True, True)
    assert history.duration_s > plan.duration_s
    assert history.chamber_c.min() >= 19.0
    assert "SIMULATED" in whole[1].text
    assert f"{history.steps} steps" in whole[1].text
    assert [row["device"] for row in whole[1].table("run", "device")] == [device.name for device in history.devices]


def test_what_was_done_stands_on_the_clock_of_the_plan_with_the_rates_that_were_turned(made):
    folder, plan, _, _ = made
    history = history_of(read_sources([folder / "run"]).run)
    assert 0.0 <= history.chamber_s.min() < history.chamber_s.max() <= plan.duration_s + 1e-9
    (planned_t, planned), (done_t, done) = planned_rate(plan, "x"), history.rates["x"]
    assert np.max(done) == pytest.approx(np.max(planned), rel=1e-6)
    assert np.min(done) == pytest.approx(np.min(planned), rel=1e-6)
    assert np.trapezoid(done, done_t) == pytest.approx(np.trapezoid(planned, planned_t), abs=1.0)
    # Every turn begins when it was to, within what counts as executed.
    begins = [t[:-1][(r[:-1] == 0.0) & (r[1:] != 0.0)] for t, r in ((planned_t, planned), (done_t, done))]
    assert len(begins[0]) == len(begins[1]) > 10
    assert np.max(np.abs(begins[0] - begins[1])) < 1.0


def test_rates_between_angles_of_a_turn_by_hand_add_up_to_the_angle():
    time, angle = np.array([0.0, 1.0, 1.01, 3.0, 4.0]), np.array([0.0, 10.0, 10.0, 90.0, 90.0])
    stepped, rate = rates_of(time, angle)
    assert np.sum(rate[::2] * np.diff(stepped)[::2]) == pytest.approx(90.0)


def test_planned_motion_turns_by_the_planned_angles(made):
    plan = made[1]
    time, rate = planned_rate(plan, "x")
    assert np.all(np.diff(time) >= -1e-9)
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])
    angles = [np.degrees(float(m.angle)) for b in plan.motion for m in b.moves if m.angle is not None]
    assert angles[:2] == pytest.approx([720.0, -720.0], abs=1.0)
    assert turned[-1] == pytest.approx(sum(angles) * plan.motion[0].repeat, abs=1e-3)
    assert turned.max() == pytest.approx(angles[0], abs=1e-3)


def test_a_page_shows_one_cycle_as_planned_and_as_done(made, whole):
    plan, block = made[1], made[1].motion[0]
    begin, end, words = planned_cycle(plan, "x")
    assert (words, block.repeat) == ("cycle 9 of 16 of ramp 1", 16)
    assert end - begin == pytest.approx(float(block.period))
    time, rate = planned_rate(plan, "x")
    inside = (time >= begin) & (time <= end)
    turns = [abs(np.degrees(float(m.angle))) for m in block.moves if m.angle is not None]
    assert np.trapezoid(np.abs(rate[inside]), time[inside]) == pytest.approx(sum(turns), abs=1e-3)
    html = whole[2]
    at = html.index('aria-labelledby="rate-x-caption"')
    svg = html[at : html.index("</figure>", at)]
    assert "in cycle 9 of 16 of ramp 1: planned and done, from the commands that were executed." in svg
    assert re.findall(r">(planned|done)</text>", svg) == ["planned", "done"]
    # A curve of each, of two turns: not of all cycles.
    curves = [path.count("L ") for path in re.findall(r'<path d="([^"]*)" clip-path', svg)]
    assert len(curves) == 2
    assert all(5 < count < 20 for count in curves)


def test_the_example_of_a_page_is_undone_by_the_calibration_itself(made, whole):
    (example,) = whole[0].examples
    true = np.radians([example.corrected])
    error = channel_error(made[2].channel[0], np.array([example.temperature_c]), {"rate x": true})
    assert np.degrees(true + error)[0] == pytest.approx(example.measured, rel=1e-13)
    assert figures(example.corrected, 9) in whole[1].text


def test_a_page_stands_alone_and_escapes_what_files_say(whole):
    _, shown, text = whole
    assert "script" not in shown.tags
    assert "A small plan <of & for> a page" in shown.text
    assert "A small plan &lt;of &amp; for&gt; a page" in text
    for place in ("http://", "https://", "//"):
        for cut in text.split(place)[1:]:
            assert cut.startswith(("www.w3.org/", "/")) or place == "//", cut[:40]
    assert 'src="' not in text
    assert len(shown.ids) == len(set(shown.ids))
    figures_there = [i for i in shown.ids if f"{i}-caption" in shown.ids]
    assert len(figures_there) == text.count("<figure") == text.count("<svg")
    # Maps before, predicted, achieved; their curves; bias curves; two tracks; two found maps.
    assert len(figures_there) == 4 + 1 + 2 + 2
    assert "nan" not in shown.text.lower().split()
    assert "None" not in shown.text


def test_json_is_the_page(made, whole, tmp_path, capsys):
    data, _, _ = whole
    output = tmp_path / "page.html"
    assert main(["report", str(made[0] / "run"), "-o", str(output), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads(json.dumps(as_tables(data)))
    shown = Page(output.read_text(encoding="utf-8"))
    assert shown.table("parameters", "parameter") == whole[1].table("parameters", "parameter")
    assert main(["report", str(made[0] / "run"), "-o", str(output)]) == 2
    assert "--force" in capsys.readouterr().err


def test_pages_of_a_recipe_and_of_a_calibration_alone(made, tmp_path):
    folder, plan, _, _ = made
    sources = read_sources([folder / "recipe.toml"])
    data = report_data_of(sources)
    assert (data.history, data.axes, data.simulated) == (None, (), False)
    shown = Page(page(sources, data))
    assert {row["parameter"] for row in shown.table("parameters", "parameter")} == {
        row.name.removeprefix("gyro_x.") for row in plan.prediction.parameters
    }
    assert "value" not in shown.table("parameters", "parameter")[0]
    alone = read_sources([folder / "run" / "calibration.toml"])
    found = report_data_of(alone)
    assert [row.achieved for row in found.requirements] == [123.456]
    assert {fact.quantity for fact in found.maps} == {"gyro_scale_factor", "gyro_bias"}
    assert "plan" not in Page(page(alone, found)).ids


def test_a_calibration_of_any_name_in_the_folder_of_a_run_is_taken_with_it(made, tmp_path):
    run = shutil.copytree(made[0] / "run", tmp_path / "run")
    (run / "calibration.toml").rename(run / "unit 7, spring.toml")
    assert read_sources([run]).calibration == made[2]
    shutil.copy(run / "unit 7, spring.toml", run / "autumn.toml")
    with pytest.raises(
        ValueError, match=r"several calibrations \(autumn.toml, unit 7, spring.toml\): also name the one that"
    ):
        read_sources([run])
    assert read_sources([run, run / "autumn.toml"]).calibration == made[2]
    shutil.copy(run / "autumn.toml", run / "calibration.toml")
    assert read_sources([run]).calibration_name.endswith("calibration.toml")


def test_prose_has_one_minus_and_one_degree_sign(whole):
    prose = Page(re.sub(r"<(pre|code)>.*?</\1>", "", whole[2], flags=re.S)).text
    assert "degC" not in prose
    assert re.search(r"(?<![\w.-])-\d", prose) is None
    assert "−" in prose
    html = '<p title="-1 degC">at -25 degC, 2026-11-22, K-1</p><pre>--to "-5 degC"</pre><code>-1</code><p>1e-5</p>'
    kept = html.replace("at -25 degC", "at −25 °C")
    assert one_sign(html) == kept


def test_prose_has_the_units_of_print_and_no_powers_of_ten():
    html = "<p>1.065e+04 ppm, 5 ug/g^2, 2 urad, 0.15 deg/sqrt(h), 20 to 26 degC</p><code>5 ug</code>"
    assert one_sign(html) == "<p>10650 ppm, 5 µg/g², 2 µrad, 0.15 deg/√h, 20 to 26 °C</p><code>5 ug</code>"


@pytest.mark.parametrize(
    ("value", "deviation", "shown"),
    [
        (319.59, 171.0, "320 ± 170"),
        (-0.025374, 3.2, "0.0 ± 3.2"),
        (-1.2345, 0.0996, "−1.23 ± 0.10"),
        (9.99e-5, 2e-6, "0.0000999 ± 0.0000020"),
        (5.0, 0.0, "5 ± 0"),
    ],
)
def test_a_value_ends_where_its_uncertainty_does(value, deviation, shown):
    assert with_uncertainty(value, deviation) == shown


def test_the_title_names_sensor_and_date(whole):
    title = re.search(r"<h1>(.*)</h1>", whole[2])[1]
    assert re.fullmatch(r"Calibration report: .+, \d{4}-\d\d-\d\d", title)
    assert f"<title>{title}</title>" in whole[2]


def test_what_is_lost_is_the_largest_of_its_kind(whole):
    rows = {row.target: row for row in whole[0].exports}
    assert rows["csv"].largest == ()
    assert len(rows["kalibr"].largest) == len({loss.split(": ")[1].split(",")[0] for loss in rows["kalibr"].losses})
    assert all(loss.endswith("(gyro x)") for loss in rows["kalibr"].largest)


def test_what_is_not_converged_has_the_colour_of_a_verdict(made):
    _, plan, _, _ = made
    sources = read_sources([made[0] / "recipe.toml"])
    for optimisation, status, verdict in (
        ({"converged": False}, "not converged: take more steps", ' class="verdict missed"'),
        ({"converged": True}, "converged: the gradient is 1e-7", ""),
    ):
        other = plan.model_copy(update={"optimisation": optimisation, "status": status})
        found = dataclasses.replace(sources, recipe=other)
        assert f"<p{verdict}>{status[0].upper()}{status[1:]}.</p>" in page(found, report_data_of(found))


def test_maps_that_look_alike_are_shown_as_a_ratio_whose_colours_tell_its_size(whole):
    fact = next(f for f in whole[0].maps if f.quantity == "gyro_scale_factor")
    ((_, box), *_) = fact.maps
    shades = []
    for factor in (1.001, 1.05, 1.09, 2.0):
        other = fact._replace(maps=(("before", box), ("predicted", box._replace(values=factor * box.values))))
        ((first, *between, _),) = map_pictures([other], {})
        assert "residual before" in first.caption
        if factor == 1.001:
            # A map that is 1 everywhere shows nothing, and is left out.
            assert between == []
            continue
        (second,) = between
        assert ("'predicted' to the remaining error 'before'" in second.caption) == (factor < 1.3)
        shades.append(second.svg)
    assert shades[0] != shades[1]


def test_another_plan_to_compare_with_and_a_limit(made, tmp_path):
    folder, plan, _, _ = made
    short = spec(**{"plan.cycle.moves[1].peak_rate": "150 deg/s"})
    (tmp_path / "before.toml").write_text(to_toml(short), encoding="utf-8")
    (tmp_path / "limit.json").write_text('[{"name": "all rates", "certified": 1.5}]', encoding="utf-8")
    sources = read_sources([folder / "recipe.toml"], before=tmp_path / "before.toml", limits=tmp_path / "limit.json")
    data = report_data_of(sources)
    assert data.before_is.startswith("the plan in before.toml")
    assert data.requirements[0].before > data.requirements[0].predicted
    assert [row.limit for row in data.requirements] == [1.5, None, None]
    # The same plan before and now leaves the same.
    same = dataclasses.replace(sources, before=plan.spec)
    assert report_data_of(same).requirements[0].before == pytest.approx(
        plan.prediction.requirements[0].judged, rel=1e-9
    )


def test_files_that_do_not_belong_together_are_named(made, tmp_path, capsys):
    folder, _, found, _ = made
    other = found.model_copy(update={"provenance": found.provenance | {"recipe": "0" * 64}})
    write_calibration(other, tmp_path / "other.toml")
    sources = read_sources([folder / "recipe.toml", tmp_path / "other.toml"])
    assert any("different recipe" in note for note in sources.notes)
    (tmp_path / "spec.toml").write_text(to_toml(spec()), encoding="utf-8")
    (tmp_path / "limit.json").write_text("{}", encoding="utf-8")
    out = str(tmp_path / "page.html")
    wrong: list[tuple[list[str], str]] = [
        ([str(tmp_path / "spec.toml"), str(folder / "recipe.toml")], "leave out the other spec"),
        ([str(tmp_path / "other.toml"), "--limits", str(tmp_path / "limit.json")], "name its recipe or its spec"),
        ([str(tmp_path)], "not the folder of a run"),
        ([str(folder / "recipe.toml")] * 2, "a second recipe"),
        ([str(tmp_path / "nothing.toml")], "nothing.toml"),
        ([str(folder / "recipe.toml"), "--limits", str(tmp_path / "limit.json")], "gradcal limit --json"),
    ]
    for words, said in wrong:
        assert main(["report", *words, "-o", out]) == 2
        assert said in capsys.readouterr().err
    assert not Path(out).exists()


@pytest.mark.parametrize("allowed", [2000.0, 75.0, 20.0])
def test_the_line_of_a_target_is_within_its_picture(made, allowed):
    fact = next(f for f in report_data_of(read_sources([made[0] / "run"])).maps if f.quantity == "gyro_scale_factor")
    axes = Figure().add_subplot()
    draw_curves(fact.maps, allowed, ax=axes)
    low, high = axes.get_ylim()
    assert low < allowed < high
    (line,) = [line for line in axes.get_lines() if line.get_label() == "target (1σ)"]
    assert set(line.get_ydata()) == {allowed}
