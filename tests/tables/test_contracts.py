"""Contracts and schemas: what they promise is what validates, for every preset and for hand-made examples."""

import json
import tomllib

import jsonschema
import pytest

from gradcal_jax.spec import presets
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.spec.contracts import Prediction
from gradcal_jax.tables.schemas import schema, schema_names


@pytest.mark.parametrize("name", schema_names())
def test_schemas_are_valid_and_closed(name):
    found = schema(name)
    jsonschema.Draft202012Validator.check_schema(found)
    version = {"calibration": 3}.get(name, 1)
    assert found["$id"] == f"gradcal-{name}/{version}"
    assert found["additionalProperties"] is False
    assert json.loads(json.dumps(found)) == found


@pytest.mark.parametrize("name", presets.names())
def test_every_preset_satisfies_the_schema_of_specs_and_slips_do_not(name):
    document = tomllib.loads(presets.text(name))
    validator = jsonschema.Draft202012Validator(schema("spec"))
    validator.validate(document)
    assert validator.is_valid({**document, "sensr": {}}) is False
    assert validator.is_valid({**document, "sensor": {"angle": "gyro"}}) is False
    document["plan"]["soak"] = 3
    assert validator.is_valid(document) is False


PREDICTION = {
    "format": "gradcal-prediction/1",
    "duration_s": 9600.0, "soak_s": 3600.0, "motion_s": 6000.0,
    "requirements": [
        {
            "name": "full range", "quantity": "gyro_scale_factor", "unit": "ppm", "axis": "x",
            "temperature_c": [-30.0, 70.0], "rate_dps": [-300.0, 300.0], "grid": [101, 121],
            "statistic": "mean of max", "mean_of_max": 85.0, "max": None, "mean": None, "rms": None,
            "target": 80.0, "verdict": "missed", "limited_by": None,
        }
    ],
    "parameters": [{"name": "b00", "std": None, "unit": "ppm"}],
    "covariance": [[None]],
    "warnings": ["b00 cannot be observed"],
}  # fmt: skip


def test_a_prediction_is_read_validated_and_written_as_json():
    jsonschema.validate(PREDICTION, schema("prediction"))
    found = Prediction.model_validate(PREDICTION)
    written = json.loads(found.model_dump_json())
    jsonschema.validate(written, schema("prediction"))
    assert Prediction.model_validate(written) == found
    with pytest.raises(ValueError, match="missing"):
        Prediction.model_validate({key: value for key, value in PREDICTION.items() if key != "duration_s"})


def test_unknown_names_get_a_sentence():
    with pytest.raises(ValueError, match='nearest: "prediction"'):
        schema("predictio")
    with pytest.raises(ValueError, match="known: spec"):
        schema("zzzzzz")


def test_presets_are_commented_titled_and_sound():
    assert len(presets.names()) == 22
    for name in presets.names():
        text = presets.text(name)
        assert text.startswith("# ")
        assert text.count("#") >= 5
        assert presets.title(name) == spec_file.parse_spec(text).title
        schedule = spec_file.parse_spec(text).schedule
        assert schedule.duration > 0.0
    with pytest.raises(ValueError, match='nearest: "tactical-mems"'):
        presets.text("tactical_mem")
