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
        assert old in text, (name, old)
        text = text.replace(old, new, 1)
    return predictions.predict(spec_file.parse_spec(text))


_RAMP = 'temperature = ["-30 degC", "70 degC"]\ngradient    = "1 K/min"\nsoak        = "1 h"'
_PROGRAMME = """programme = [
  { soak = "1 h", at = "-30 degC", used = true }, { ramp_to = "70 degC", rate = "1 K/min" },
]"""
_STANDARD, _STATIC = "paper-dynamic-standard", "paper-static-gradient"


@pytest.mark.parametrize(
    ("preset", "change", "statistics", "expected", "within"),
    [
        ("paper-dynamic-gradient", (), "mean_of_max", (86.0, 43.0), 0.0232),
        (_STANDARD, (), "mean_of_max", (103.3, 81.5), 0.01),
        (_STANDARD, (('"best linear"', '"least squares"'),), "mean_of_max", (127.4, 100.5), 0.01),
        ("paper-static-standard", (), "mean max", (0.279, 0.372), 0.01),
        (_STATIC, (), "mean max", (0.402, 0.775), 0.01),
        *(
            pytest.param(_STATIC, (change,), "mean max", expected, 0.01, marks=pytest.mark.evidence)
            for change, expected in (
                ((_RAMP, _PROGRAMME), (0.358, 0.760)),
                (('"1 K/min"', '"0.5 K/min"'), (0.290, 0.576)),
                (('"1 K/min"', '"2 K/min"'), (0.547, 1.004)),
            )
        ),
    ],
)
def test_the_paper_s_plans(preset, change, statistics, expected, within):
    rows = predict(preset, *change).requirements
    found = [getattr(row, name) for name in statistics.split() for row in rows]
    assert found == pytest.approx(expected, rel=within)


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
    rates = 'rates        = ["-300 deg/s", "-150 deg/s", "-10 deg/s", "10 deg/s", "150 deg/s", "300 deg/s"]'
    prediction = predict(_STANDARD, (rates, 'rates = ["-100 deg/s", "100 deg/s"]'))
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
