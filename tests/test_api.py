"""The design's known answers, from the presets' text to the prediction; and predictions that say what they cannot."""

import json

import jax
import numpy as np
import pytest

from gradcal_jax.information import prediction as predictions
from gradcal_jax.spec import presets
from gradcal_jax.spec import spec as spec_file


def predict(name: str, *changes: tuple[str, str]):
    text = presets.text(name)
    for old, new in changes:
        assert text.count(old) == 1, (name, old)
        text = text.replace(old, new)
    return predictions.predict(spec_file.parse_spec(text))


def by_name(prediction):
    return {row.name: row for row in prediction.requirements}


def test_the_dynamic_gradient_plan():
    found = by_name(predict("paper-dynamic-gradient"))
    assert 84.0 < found["full range"].mean_of_max < 88.0
    assert 42.0 < found["reduced range"].mean_of_max < 44.0
    assert found["full range"].verdict == "missed"  # The paper's 77 ppm, asked for as 80, are not reached.
    assert found["reduced range"].verdict is None


def test_the_dynamic_standard_plan_best_and_unweighted():
    best = by_name(predict("paper-dynamic-standard"))
    assert best["full range"].mean_of_max == pytest.approx(103.3, rel=0.01)
    assert best["reduced range"].mean_of_max == pytest.approx(81.5, rel=0.01)
    text = presets.text("paper-dynamic-standard").replace('"best linear"', '"least squares"', 1)
    plain = by_name(predictions.predict(spec_file.parse_spec(text)))
    assert plain["full range"].mean_of_max == pytest.approx(127.4, rel=0.01)
    assert plain["reduced range"].mean_of_max == pytest.approx(100.5, rel=0.01)


def test_the_static_standard_plan():
    row = predict("paper-static-standard").requirements[0]
    assert row.mean == pytest.approx(0.279, rel=0.01)
    assert row.max == pytest.approx(0.372, rel=0.01)


_RAMP = 'temperature = ["-30 degC", "70 degC"]\ngradient    = "1 K/min"\nsoak        = "1 h"'
_PROGRAMME = """programme = [
  { soak = "1 h", at = "-30 degC", used = true }, { ramp_to = "70 degC", rate = "1 K/min" },
]"""


@pytest.mark.parametrize(
    ("old", "new", "mean", "largest"),
    [
        ("1 K/min", "1 K/min", 0.402, 0.775),
        pytest.param(_RAMP, _PROGRAMME, 0.358, 0.760, marks=pytest.mark.evidence),
        pytest.param('"1 K/min"', '"0.5 K/min"', 0.290, 0.576, marks=pytest.mark.evidence),
        pytest.param('"1 K/min"', '"2 K/min"', 0.547, 1.004, marks=pytest.mark.evidence),
    ],
)
def test_the_static_gradient_plan(old, new, mean, largest):
    row = predict("paper-static-gradient", (old, new)).requirements[0]
    assert row.mean == pytest.approx(mean, rel=0.01)
    assert row.max == pytest.approx(largest, rel=0.01)


@pytest.mark.parametrize("name", ["paper-dynamic-gradient", "paper-dynamic-standard"])
def test_a_prediction_compiles_nothing(name):
    """Not with its shares of the error sources, either; the counter does count."""
    compiled: list[str] = []
    listen = lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        predictions.predict(spec_file.parse_spec(presets.text(name)), limits=True)
        assert compiled == []
        jax.jit(lambda x: x + len(name))(1.0)
        assert compiled != []
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_what_a_plan_cannot_observe_is_null_with_a_sentence():
    """Four parameters in rate from two rates: the prediction is JSON without nan, and names the parameters."""
    text = presets.text("paper-dynamic-standard")
    start = text.index("rates", text.index("[plan]"))
    line = text[start : text.index("\n", start)]
    text = text.replace(line, 'rates = ["-100 deg/s", "100 deg/s"]')
    prediction = predictions.predict(spec_file.parse_spec(text))
    assert all(row.mean_of_max is None and row.verdict == "unobservable" for row in prediction.requirements)
    sentences = [w for w in prediction.warnings if "cannot observe" in w]
    (sentence,) = sentences
    assert sentence.endswith("turn about the gyro, at more rates and temperatures, or state a prior")
    assert {f"gyro_x.b{j}{i}" for i in range(4) for j in range(4)} == set(
        sentence.split(": ")[0].split("observe ")[1].split(", ")
    )
    plain = json.loads(prediction.model_dump_json(), parse_constant=pytest.fail)
    assert any(row["std"] is None for row in plain["parameters"])
    flat = [x for row in plain["covariance"] for x in row if x is not None]
    assert np.all(np.isfinite(flat))
    assert np.all(np.abs(flat) < 1e30)
