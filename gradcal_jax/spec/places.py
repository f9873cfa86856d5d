"""The spec of the IMU at one place of a fixture.

The table's mounting is that of the fixture, and a place that of an IMU in it: body → fixture → innermost axis.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gradcal_jax.spec.bench import Mounting, Place
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def specs_at_places(spec: Spec) -> dict[str, Spec]:
    """The spec of the IMU at each place, by the place's name; of a table without places the spec itself, by ""."""
    return {place.name: _at(spec, place) for place in spec.rig.table.place} or {"": spec}


def hung_alike(spec: Spec) -> list[tuple[Spec, list[str]]]:
    """The spec of the IMU at each place that hangs differently, with the names of the places that hang so; of a table
    without places the spec itself."""
    alike: dict[str, tuple[Spec, list[str]]] = {}
    for name, at in specs_at_places(spec).items():
        hung = [m.model_dump(exclude={"name"}) for m in at.rig.table.mounting]
        alike.setdefault(repr((hung, at.sensor.model_dump())), (at, []))[1].append(name)
    return list(alike.values())


def places_of(spec: Spec, names: Sequence[str]) -> dict[str, str]:
    """The place of every IMU of a log: that of its name, or else the first IMU at the first place and so on.

    Errors: `ValueError` for more IMUs than places, or names that are places of some and not of all.
    """
    places = [place.name for place in spec.rig.table.place]
    if set(names) <= set(places):
        return {name: name for name in names}
    if some := [name for name in names if name in places]:
        others = ", ".join(name for name in names if name not in places)
        raise ValueError(
            f"{some[0]} is the name of a place, but {others} is not: name all IMUs after their places, or none of them"
        )
    if len(names) > len(places):
        raise ValueError(
            f"the log has {len(names)} IMUs, and the spec has {len(places)} places: add the missing [[rig.table.place]]"
        )
    return dict(zip(names, places, strict=False))


def _at(spec: Spec, place: Place) -> Spec:
    table = spec.rig.table
    mountings = tuple(_composed(mounting, place) for mounting in table.mounting)
    changes = {"table": table.model_copy(update={"mounting": mountings, "place": ()})}
    return spec.model_copy(update={"rig": spec.rig.model_copy(update=changes)})


def _composed(fixture: Mounting, place: Place) -> Mounting:
    """The mounting of the IMU on the innermost axis."""
    import numpy as np
    from scipy.spatial.transform import Rotation  # pyright: ignore[reportMissingTypeStubs]

    exact = np.array(fixture.columns).T @ np.array(place.columns).T
    whole = rotation_of(fixture) @ rotation_of(place)
    named = dict(zip("xyz", (_direction(column) for column in exact.T), strict=True))
    further = Rotation.from_matrix(exact.T @ whole).as_rotvec()
    rotation = {}
    if float(np.max(np.abs(further))) > 1e-12:
        rotation = {"rotation": tuple(Quantity.of(float(a), "deg") for a in further)}
    accuracy = math.hypot(float(fixture.accuracy), float(place.accuracy))
    return Mounting(name=fixture.name or place.name, **named, **rotation, accuracy=Quantity.of(accuracy, "deg"))  # pyright: ignore[reportArgumentType]


def rotation_of(held: Mounting) -> "NDArray[np.float64]":
    """The rotation `(3, 3)` from the body of an IMU to what holds it: the fixture, or the innermost axis."""
    import numpy as np
    from scipy.spatial.transform import Rotation  # pyright: ignore[reportMissingTypeStubs]

    vector = np.zeros(3) if held.rotation is None else np.array([float(a) for a in held.rotation])
    return np.array(held.columns).T @ Rotation.from_rotvec(vector).as_matrix()


def _direction(column: Sequence[float]) -> str:
    """The name of a unit vector along an axis."""
    k = max(range(3), key=lambda i: abs(column[i]))
    return ("+" if column[k] > 0.0 else "-") + "xyz"[k]
