"""The description of a written log, as gradcal-log/1 has it."""

import json

from gradcal_jax.records.log_contents import LogContents


def contents(dataset):
    """The description of an opened log (an xarray dataset). Raises `ValueError` where it is none."""
    names = ["time", *map(str, dataset.data_vars)]
    variables = {
        name: {"dimensions": tuple(map(str, dataset[name].dims)), "units": str(dataset[name].attrs.get("units", "1"))}
        for name in names
    }
    labels = {
        name: tuple(str(label) for label in dataset[name].values)
        for name in ("unit", "axis", "force_axis", "table_axis")
        if name in dataset.coords
    }
    return LogContents.model_validate(
        {
            "format": str(dataset.attrs.get("format")),
            "labels": labels,
            "variables": variables,
            "rows": int(dataset.sizes["time"]),
            "rows_read": int(dataset.attrs.get("rows_read", 0)),
            "rows_removed": json.loads(str(dataset.attrs.get("rows_removed", "{}"))),
            "simulated": int(dataset.attrs.get("simulated", 0)),
            "provenance": json.loads(str(dataset.attrs.get("provenance", "{}"))),
        }
    )
