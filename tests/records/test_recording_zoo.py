"""The zoo of recordings: every record is right within its own interval, or a question or note names its kind."""

import re

import pytest
from recording_zoo import ZOO, N

from gradcal_jax.identify.instability import allan_notes, allan_of, at_rest, of_sensor
from gradcal_jax.records.importers import import_log
from gradcal_jax.records.log import Log
from gradcal_jax.units import DEG_PER_SQRT_H

WITHIN = 4.0  # standard errors; of a hundred records one is 2.6 off


def looked_at(log: Log) -> tuple[float, float, list[str]]:
    """N and its standard error (deg/sqrt(h)), and all that is said."""
    rest = at_rest(log)
    fit = of_sensor(rest, allan_of(rest)[1])
    walk = fit.angle_random_walk
    said = [*(finding.message for finding in log.findings), *rest.messages, *allan_notes(fit)]
    return walk.value * DEG_PER_SQRT_H, walk.standard_error * DEG_PER_SQRT_H, said


@pytest.mark.parametrize("name", ZOO)
def test_a_record_is_right_or_asked_about(name, tmp_path):
    record = ZOO[name](tmp_path)
    try:
        walk, error, said = looked_at(import_log(record.path, record.columns))
    except ValueError as question:
        walk, error, said = float("nan"), float("nan"), [str(question)]
    if record.asks is None:
        assert abs(walk - N) < WITHIN * error, (walk, error, said)
        assert error < 0.2 * walk
    else:
        assert any(re.search(record.asks, one) for one in said), (walk, error, said)
