"""Figures: drawn where they are told, labelled with units, honest about what a plan cannot observe."""

import inspect

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import gradcal_jax as gj
from gradcal_jax import plots
from gradcal_jax.estimation.calibrations import Box

TEMPERATURE = np.linspace(-30.0, 70.0, 21)
RATE = np.linspace(-300.0, 300.0, 31)
BOWL = 20.0 + (TEMPERATURE[:, None] / 50.0) ** 2 + (RATE[None, :] / 100.0) ** 2
MAP = Box(TEMPERATURE, RATE, BOWL, "ppm")


@pytest.fixture
def axes():
    return Figure(layout="constrained").add_subplot()


@pytest.fixture(scope="module")
def bias_spec():
    return gj.parse_spec(gj.presets.text("paper-static-gradient"))


def ink(figure):
    """Render it: what a label or a colour bar would refuse, it refuses here."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def test_a_map_shows_its_values_on_the_axes_given(axes):
    ax, mesh = plots.draw_map(TEMPERATURE, RATE, BOWL, "ppm", title="full range", ax=axes)
    assert ax is axes
    np.testing.assert_array_equal(np.ma.getdata(mesh.get_array()).reshape(BOWL.shape), BOWL)
    assert len(axes.collections) == 2
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("rate, deg/s", "temperature, °C", "full range")
    assert mesh.colorbar.ax.get_ylabel() == "residual (1σ), ppm"
    assert len(np.unique(ink(axes.figure).reshape(-1, 4), axis=0)) > 50


def test_without_axes_every_function_makes_a_figure_of_its_own(bias_spec):
    drawn = [
        plots.draw_map(TEMPERATURE, RATE, BOWL, "ppm")[0],
        plots.draw_curves([("a plan", MAP)])[0],
        plots.draw_temperature(bias_spec)[0],
    ]
    assert len({id(ax.figure) for ax in drawn}) == len(drawn)
    for ax in drawn:
        assert "," in ax.get_xlabel()
        assert "," in ax.get_ylabel()
        ink(ax.figure)


def test_what_cannot_be_observed_stays_blank(axes):
    half = BOWL.copy()
    half[:, RATE > 100.0] = np.inf
    _, mesh = plots.draw_map(TEMPERATURE, RATE, half, "ppm", ax=axes)
    hidden = np.ma.getmaskarray(mesh.get_array()).reshape(half.shape)
    np.testing.assert_array_equal(hidden, np.isinf(half))
    assert mesh.get_clim()[1] == BOWL[:, RATE <= 100.0].max()
    ink(axes.figure)


@pytest.mark.parametrize("value", [np.inf, 3.0])
def test_a_map_of_one_value_or_of_none_has_no_contours_and_no_warning(axes, value):
    plots.draw_map(TEMPERATURE, RATE, np.full_like(BOWL, value), "ppm", ax=axes)
    assert len(axes.collections) == 1
    ink(axes.figure)


def test_the_worst_over_temperature_is_the_maximum_and_what_cannot_be_observed_is_a_gap(axes):
    broken = BOWL.copy()
    broken[3, 5] = np.inf
    _, (line, second) = plots.draw_curves([("a plan", MAP), ("another", MAP._replace(values=broken))], ax=axes)
    np.testing.assert_array_equal(line.get_ydata(), BOWL.max(axis=0))
    assert axes.get_ylim()[0] == 0.0
    assert axes.get_ylabel().endswith("ppm")
    assert line.get_label() == "a plan"
    assert np.flatnonzero(np.isnan(second.get_ydata())).tolist() == [5]
    assert (second.get_color(), second.get_linestyle()) != (line.get_color(), line.get_linestyle())
    ink(axes.figure)


def test_curves_of_nothing_observed_draw_without_a_warning(axes):
    nothing = Box(TEMPERATURE, np.zeros(1), np.full((len(TEMPERATURE), 1), np.inf), "deg/h")
    _, (line,) = plots.draw_curves([("a plan", nothing)], ax=axes)
    assert np.isnan(line.get_ydata()).all()
    ink(axes.figure)


def test_the_temperature_track_goes_as_the_plan_does(axes, bias_spec):
    ax, line = plots.draw_temperature(bias_spec, ax=axes)
    assert ax is axes
    hours, temperature = line.get_data()
    assert (hours[0], hours[-1]) == (0.0, pytest.approx(160.0 / 60.0))
    assert (np.diff(hours) >= 0.0).all()
    np.testing.assert_allclose(np.interp([0.0, 1.0, 160.0 / 60.0], hours, temperature), [-30.0, -30.0, 70.0], atol=1e-9)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time, h", "chamber, °C")


def test_a_prediction_and_a_comparison_have_a_panel_for_each_requirement(bias_spec):
    colder = gj.changed(bias_spec, {"requirement[0].temperature": ["-20 degC", "60 degC"]})
    one = plots.draw_comparison([("a plan", bias_spec)])
    two = plots.draw_comparison([("full", bias_spec), ("reduced", colder)])
    assert [ax.get_title() for ax in one.axes] == ["full range"]
    (panel,) = two.axes
    assert [line.get_label() for line in panel.lines] == ["full", "reduced"]
    full, reduced = (np.asarray(line.get_ydata()) for line in panel.lines)
    assert full.max() > reduced.max() > 0.0
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["full", "reduced"]
    ink(two)


def test_every_picture_can_be_drawn_on_axes_or_a_figure_of_ones_own(bias_spec):
    for name in (name for name in plots.__all__ if name.startswith("draw_")):
        parameters = inspect.signature(getattr(plots, name)).parameters
        assert {"ax", "figure"} & {key for key, own in parameters.items() if own.default is None}, name
    whole = Figure(layout="constrained")
    left, right = whole.subfigures(1, 2)
    assert plots.draw_comparison([("reduced", bias_spec)], figure=left) is whole
    assert plots.draw_comparison([("full", bias_spec)], figure=right) is whole
    assert [len(part.axes) for part in (left, right)] == [1, 1]
    ink(whole)


def test_nothing_to_draw_is_a_sentence(bias_spec):
    bare = gj.parse_spec(gj.presets.text("paper-static-gradient").split("[[requirement]]")[0] + PLAN)
    with pytest.raises(ValueError, match=r"\[\[requirement\]\]"):
        plots.draw_comparison([("bare", bare)])


PLAN = """
[plan]
method      = "gradient"
temperature = ["-30 degC", "70 degC"]
gradient    = "1 K/min"
"""


@pytest.mark.parametrize(("ending", "head"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_a_figure_is_written_in_the_format_of_its_name(axes, tmp_path, ending, head):
    axes.plot([0.0, 1.0])
    plots.save(axes.figure, tmp_path / f"figure.{ending}")
    assert (tmp_path / f"figure.{ending}").read_bytes().startswith(head)


@pytest.mark.parametrize("name", ["figure", "figure.docx", "no/such/figure.png"])
def test_a_name_that_cannot_be_written_is_a_sentence(axes, tmp_path, name):
    with pytest.raises((ValueError, OSError), match=r"end in one of|No such file"):
        plots.save(axes.figure, tmp_path / name)
