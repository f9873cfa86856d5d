"""Every quantity that a requirement may limit: one row of `QUANTITIES`, one class, and a prediction."""

from typing import get_args

import pytest

import gradcal_jax as gj
from gradcal_jax.spec.requirement import QUANTITIES, Requirement

CLASSES = {name: of for of in get_args(Requirement) for name in get_args(of.__annotations__["quantity"])}


def required(quantity):
    keys = {"name": quantity, "quantity": quantity, "temperature": ["19 degC", "21 degC"]}
    rates = {"rate": ["-100 deg/s", "100 deg/s"]} if "rate" in CLASSES[quantity].model_fields else {}
    return keys | rates


@pytest.fixture(scope="module")
def rows():
    changes = {
        "sensor.gyro.bias.temperature.degree": 1,
        "sensor.accelerometer.second_order": {"prior": "1000 ug/g^2"},
        "requirement": [required(quantity) for quantity in QUANTITIES],
    }
    spec = gj.changed(gj.parse_spec(gj.presets.text("ferraris")), changes)
    return {row.quantity: row for row in gj.predict(spec).requirements}


def test_every_class_has_a_row_of_the_table():
    assert CLASSES.keys() == QUANTITIES.keys()


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_every_quantity_predicts_an_error_in_its_unit(rows, quantity):
    """Zero would be the error of a term that no channel has."""
    assert rows[quantity].unit == QUANTITIES[quantity].unit
    assert rows[quantity].decisive > 0.0


def test_no_two_quantities_are_one(rows):
    assert len({row.decisive / QUANTITIES[quantity].factor for quantity, row in rows.items()}) == len(QUANTITIES)
