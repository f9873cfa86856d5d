"""A log that ends before its plan does: what it lacks is said."""

from dataclasses import replace

from logs_zoo import spec_of
from simulated_log import simulate_log

from gradcal_jax.estimation.estimate import estimate_log, estimate_rows
from gradcal_jax.estimation.findings import lacks_of
from gradcal_jax.records.log import Log


def cut(log: Log, share: float) -> Log:
    end = int(share * len(log.time_s))
    assert log.readings is not None
    return replace(
        log,
        time_s=log.time_s[:end],
        rate_rad_per_s=log.rate_rad_per_s[:, :end],
        temperature_c=log.temperature_c[:, :end],
        standstill=log.standstill[:end],
        readings=log.readings.chosen(log.readings.row < end),
        rows_read=end,
    )


def test_a_log_that_ends_early_says_what_it_lacks():
    spec = spec_of()
    log = simulate_log(spec, sample_rate_hz=20.0, seed=5, readings=True).log
    planned = sum(stretch.duration for stretch in spec.schedule.stretches)
    report = estimate_log(spec, [cut(log, 0.6)])
    (calibration,), (said,) = report.calibrations, report.messages.values()
    assert calibration.lacks is not None
    assert f"of the plan's {planned:.4g} s (60%)" in calibration.lacks
    assert calibration.lacks in said
    assert calibration.lacks in estimate_rows(report)["units"][0]["messages"]
    assert lacks_of(spec, [log]) is None
