"""Contracts and schemas: what they promise is what validates, for every preset and for hand-made examples."""

import json
import tomllib

import jsonschema
import pytest

from gradcal_jax.spec import presets
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.tables.contracts import Prediction
from gradcal_jax.tables.schemas import schema, schema_names
from gradcal_jax.tables.timeline import Timeline


@pytest.mark.parametrize("name", schema_names())
def test_schemas_are_valid_and_closed(name):
    found = schema(name)
    jsonschema.Draft202012Validator.check_schema(found)
    version = {"timeline": 3, "calibration": 2}.get(name, 1)
    assert found["$id"] == f"gradcal-{name}/{version}"
    assert found["additionalProperties"] is False
    assert json.loads(json.dumps(found)) == found
    assert schema(f"gradcal-{name}/{version}") == found
    with pytest.raises(ValueError, match=f"gradcal-{name}/{version}"):
        schema(f"gradcal-{name}/{3 - version}")


@pytest.mark.parametrize("name", presets.names())
def test_every_preset_satisfies_the_schema_of_specs_and_slips_do_not(name):
    document = tomllib.loads(presets.text(name))
    validator = jsonschema.Draft202012Validator(schema("spec"))
    validator.validate(document)
    assert validator.is_valid({**document, "sensr": {}}) is False
    assert validator.is_valid({**document, "sensor": {"angle": "gyro"}}) is False
    document["plan"]["soak"] = 3
    assert validator.is_valid(document) is False


TIMELINE = {
    "format": "gradcal-timeline/3",
    "frame": "table axes",
    "site": {"latitude": 0.8, "gravity": 9.81, "earth_rate": [0.0, 5.1e-5, 5.2e-5]},
    "table": [
        {"name": "x", "direction": [0.0, 0.0, 1.0], "reading_noise": 8.7e-4, "standstill_offset": 0.0}
    ],
    "standing": "read",
    "mountings": [{"rotation": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]}],
    "channels": [
        {
            "name": "gyro_x", "kind": "gyro", "axis": "x", "white": 2.9e-5, "drift": [{"sigma": 4.8e-6, "tau": 120.0}],
            "terms": [
                {
                    "name": "scale_factor", "signals": ["rate x"], "parameters": ["gyro_x.b00"], "unit": "1",
                    "temperature": {
                        "basis": "polynomial", "degree": 0, "centre": 20.0, "scale": 50.0,
                        "prior_functions": "monomial",
                    },
                    "prior": None,
                }
            ],
        }
    ],
    "installation": [],
    "segments": [
        {
            "start": 0.0, "duration": 10.0, "shape": "rest", "temperature_start": -30.0, "temperature_end": -29.9,
            "angles_before": [0.0], "angles_after": [0.0], "mounting": 0, "standstill_ids": [0],
            "attitude": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
        },
    ],
    "readings": [{"start": 0.0, "time": 1.0, "channels": ["gyro_x"], "standstill_ids": [0]}],
}  # fmt: skip
PREDICTION = {
    "format": "gradcal-prediction/1",
    "duration_s": 9600.0, "soak_s": 3600.0, "motion_s": 6000.0,
    "requirements": [
        {
            "name": "full range", "quantity": "scale_factor", "unit": "ppm", "axis": "x",
            "temperature_c": [-30.0, 70.0], "rate_dps": [-300.0, 300.0], "grid": [101, 121],
            "statistic": "mean of max", "mean_of_max": 85.0, "max": None, "mean": None, "rms": None,
            "target": 80.0, "verdict": "missed", "limited_by": None,
        }
    ],
    "parameters": [{"name": "b00", "std": None, "unit": "ppm"}],
    "covariance": [[None]],
    "warnings": ["b00 cannot be observed"],
}  # fmt: skip


@pytest.mark.parametrize(
    ("model", "name", "example"), [(Timeline, "timeline", TIMELINE), (Prediction, "prediction", PREDICTION)]
)
def test_contracts_read_validate_and_write_json(model, name, example):
    jsonschema.validate(example, schema(name))
    found = model.model_validate(example)
    written = json.loads(found.model_dump_json())
    jsonschema.validate(written, schema(name))
    assert model.model_validate(written) == found
    for key in ("channels", "requirements"):
        if key in example:
            with pytest.raises(ValueError, match="missing"):
                model.model_validate({k: v for k, v in example.items() if k != key})


def test_contracts_never_carry_nan_or_infinity():
    for bad in (float("nan"), float("inf")):
        broken = {**PREDICTION, "duration_s": bad}
        with pytest.raises(ValueError, match="duration_s"):
            Prediction.model_validate(broken)


def test_unknown_names_get_a_sentence():
    with pytest.raises(ValueError, match='nearest: "timeline"'):
        schema("timelin")
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
