"""The IMUs of a fixture: places that hang alike, and what is known of each from all of them together."""

from collections.abc import Sequence

from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.files.places import specs_at_places
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import Posterior


def hung_alike(spec: Spec) -> list[tuple[Spec, list[str]]]:
    """The spec of the IMU at each place that hangs differently, with the names of the places that hang so; of a table
    without places the spec itself."""
    alike: dict[str, tuple[Spec, list[str]]] = {}
    for name, at in specs_at_places(spec).items():
        hung = [m.model_dump(exclude={"name"}) for m in at.rig.table.mounting]
        alike.setdefault(repr((hung, at.sensor.model_dump())), (at, []))[1].append(name)
    return list(alike.values())


def known_together(
    builts: Sequence[BuiltImu], alone: Sequence[Posterior], counts: Sequence[int]
) -> tuple[list[Posterior], str]:
    """The posteriors of IMUs at places that hang differently, estimated together with all others of the fixture. Where
    the plan has more readings than can be held so, those of each `alone`, with a sentence."""
    if sum(counts) == 1:
        return list(alone), ""
    # Imported where it is used: estimates import SciPy's larger rooms.
    from gradcal_jax.estimation import posteriors_together

    plans = [(b.model, b.motion, b.body_nodes(), one) for b, one in zip(builts, alone, strict=True)]
    try:
        return posteriors_together(plans, counts, clock=builts[0].spec.sensor.takes_host_clock), ""
    except MemoryError as error:
        return list(alone), f"{error}: each place is predicted for an IMU alone"
