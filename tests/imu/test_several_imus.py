"""IMUs at the places of a fixture, in one log: each is estimated by itself, by the spec of its place."""

from dataclasses import replace

import numpy as np
import pytest
from estimate_scenes import draw_truth, scene
from imu_twin import record

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.bench import Place
from gradcal_jax.spec.places import specs_at_places
from gradcal_jax.spec.spec_sections import Spec

NAMES = ("a", "b")
PLACES = (Place(name="a"), Place(name="b", x="+x", y="-y", z="-z"))


def with_places(spec: Spec, places: tuple[Place, ...] = PLACES) -> Spec:
    table = spec.rig.table.model_copy(update={"place": places})
    return spec.model_copy(update={"rig": spec.rig.model_copy(update={"table": table})})


def fixture_log(spec: Spec, seed: int) -> Log:
    """A log of two IMUs on one table."""
    rng = np.random.default_rng(seed)
    logs: list[Log] = []
    for name, at in specs_at_places(with_places(spec)).items():
        (log,) = record(at, draw_truth(at, rng), rng, name=name, table_rng=np.random.default_rng(seed + 1000))
        logs.append(log)
    first = logs[0]

    def stack(of: str) -> np.ndarray:
        return np.concatenate([getattr(log, of) for log in logs])

    return replace(
        first,
        rate_rad_per_s=stack("rate_rad_per_s"),
        units=NAMES,
        temperature_c=stack("temperature_c"),
        specific_force_m_per_s2=stack("specific_force_m_per_s2"),
    )


@pytest.mark.long
def test_each_imu_is_estimated_by_the_spec_of_its_place():
    """By the names of the places, or by their order."""
    spec = scene("two axes", 1.0)
    log = fixture_log(spec, 5)
    found = estimate_sensors(with_places(spec), [log])
    assert [one.unit for one in found] == list(NAMES)
    for one, at in zip(found, specs_at_places(with_places(spec)).values(), strict=True):
        (alone,) = estimate_sensors(at, [log], units=[one.unit])
        assert one.calibration.values() == alone.calibration.values()
    renamed = replace(log, units=("s1", "s2"))
    (second,) = estimate_sensors(with_places(spec), [renamed], units=["s2"])
    assert second.calibration.values() == found[1].calibration.values()


def test_more_imus_than_places_are_refused():
    spec = scene("two axes", 1.0)
    with pytest.raises((ValueError, LogError), match=r"the log has 2 IMUs, and the spec has 1 places"):
        estimate_sensors(with_places(spec, PLACES[:1]), [replace(fixture_log(spec, 5), units=("s1", "s2"))])
