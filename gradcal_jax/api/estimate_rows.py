"""The numbers of an estimate for programs."""

from typing import Any

import numpy as np

from gradcal_jax.api.contract_rows import coefficient_rows, finite, requirement_fields
from gradcal_jax.api.estimate import EstimateReport, SensorEstimate
from gradcal_jax.api.path_dependence import PathDependence
from gradcal_jax.estimation import Group, Smoothness
from gradcal_jax.units import DEG_PER_S, PPM


def estimate_rows(report: EstimateReport) -> dict[str, Any]:
    """All numbers for `--json`."""
    return {
        "simulated": any(c.simulated for c in report.calibrations),
        "as_wished": report.as_wished,
        "discrepancies": [row._asdict() for row in report.discrepancies],
        "units": [_sensor_rows(one) for one in report.sensors],
    }


def _sensor_rows(report: SensorEstimate) -> dict[str, Any]:
    """All numbers of an estimate for `--json`, in SI unless they have a unit beside them."""
    calibration, tests = report.calibration, report.consistency
    return {
        "unit": report.unit,
        "simulated": calibration.simulated,
        "readings": len(report.solution.weights),
        "rows": dict(report.counts),
        "parameters": coefficient_rows(calibration),
        "covariance": None if calibration.covariance is None else calibration.covariance.model_dump(mode="json"),
        "valid_temperature_c": [float(t) for t in calibration.valid_temperature],
        "valid_rate_dps": [float(r) * DEG_PER_S for r in calibration.valid_rate],
        "lag_s": report.lag.seconds,
        "lag_std_s": report.lag.std,
        "smoothness": _smoothness_rows(report.smoothness),
        "neighbours": [_group_row(name, group) for name, own in report.neighbours.items() for group in own],
        "down_weighted": int(np.count_nonzero(report.solution.weights < 1.0)),
        "noise_scale": finite(tests.noise_scale),
        "share_beyond_three_sigma": tests.beyond_three,
        "largest_residual_sigma": tests.largest,
        "table": [row.model_dump(mode="json") for row in calibration.table],
        "requirements": [requirement_fields(row) for row in report.requirements],
        "internal_misalignment": [row._asdict() for row in report.internal],
        "gravity_rms_m_per_s2": report.gravity,
        "tests": [row.model_dump(mode="json") for row in calibration.fit],
        "structure": [
            {
                "channel": channel,
                "quantity": t.quantity,
                "test": t.test._asdict(),
                "false_alarm": t.false_alarm,
                "noticed": t.noticed,
                "asked": t.asked,
            }
            for channel, t in report.structure
        ],
        "messages": list(report.messages),
        "path": None if report.path is None else _path_rows(report.path),
    }


def _smoothness_rows(chosen: Smoothness | None) -> list[dict[str, Any]] | None:
    if chosen is None:
        return None
    return [{"channel": channel, "map": name, "std": std} for (channel, name), std in chosen.stds.items()]


def _group_row(channel: str, group: Group) -> dict[str, Any]:
    return {
        "channel": channel,
        "temperature_c": group.temperature_c,
        "rate_dps": group.rate_rad_per_s * DEG_PER_S,
        "moves": group.moves,
        "scale_factor_ppm": group.scale_factor * PPM,
        "standard_error_ppm": None if group.standard_error is None else group.standard_error * PPM,
        "map_ppm": group.of_map * PPM,
    }


def _path_rows(path: PathDependence) -> dict[str, Any]:
    """Half-differences of heating and cooling, and the terms that explain them, for `--json`, SI."""
    differences = [
        d._replace(**{k: getattr(d, k).tolist() for k in ("temperature_c", "value", "std")}) for d in path.differences
    ]
    return {
        "half_differences": [d._asdict() for d in differences],
        "offers": [offer._asdict() for offer in path.offers],
    }
