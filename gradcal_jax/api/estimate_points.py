"""The estimate of a gyro from a table of points, the data of the standard method."""

import numpy as np

from gradcal_jax import estimation, trajectory
from gradcal_jax.api.estimate import SensorEstimate, report_of, with_earth
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.fitted_rows import Recorded, fit_of
from gradcal_jax.api.imu_build import build_imu
from gradcal_jax.api.record_faults import RecordFaults
from gradcal_jax.api.recorded_rows import imu_rows
from gradcal_jax.api.systematic import omitted_noise_of_imu
from gradcal_jax.estimation import TablePoints
from gradcal_jax.files.changes import changed
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.points import RatePoints
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.spec_sections import Spec


def estimate_points(
    spec: Spec, points: RatePoints, *, options: Options | None = None, sources: dict[str, str] | None = None
) -> SensorEstimate:
    """The calibration of one gyro from a table of points (temperature, reference rate, output, σ), by the spec's model.

    Points are independent except for the reference's error; their noise is their own σ or, without it, the spec's.
    Errors: `LogError` for a spec without a standard plan or of other channels, and for too few points.
    """
    if not isinstance(spec.plan, StandardPlan):
        raise LogError('a table of points is of the standard method: give a spec with method = "standard"')
    if spec.sensor.accelerometer is not None or spec.sensor.gyro is None or spec.sensor.gyro.axes != (points.axis,):
        raise LogError(f"the points are of gyro {points.axis}: give a spec of that gyro alone")
    count = len(points.output_rad_per_s)
    if count < 2:
        raise LogError(f"{points.source}: {count} points are too few")
    omitted = omitted_noise_of_imu(build_imu(spec))
    spec, options = changed(spec, {"plan.points": "independent"}), options or Options()
    built = build_imu(spec if options.earth_rate is None else with_earth(spec, options.earth_rate))
    schedule = spec.schedule
    assert isinstance(schedule, StandardSchedule)
    # A point is two rows, of its begin and its end, at one temperature; as much time lies between two points.
    both = lambda x: np.repeat(x, 2)  # noqa: E731
    time = schedule.integration * np.arange(2.0 * count)
    warm = both(points.temperature_c)
    log = Log(
        time, both(points.output_rad_per_s)[None, :, None], (points.unit,), (points.axis,),
        warm[None], (points.axis,),
        table_rate_rad_per_s=both(points.reference_rad_per_s)[:, None],
        simulated=points.simulated, provenance={"source": points.source},
    )  # fmt: skip
    between = np.arange(2 * count - 1) % 2 == 1
    line = trajectory.held(
        time[:-1], np.diff(time), np.where(between, 0.0, both(points.reference_rad_per_s)[:-1]), warm[:-1], warm[1:],
        read=~between, at_rest=between, moving=~between, gap=between, rates=True, points="independent",
    )  # fmt: skip
    rows, _ = imu_rows(built, [log], points.unit, options)
    own = (
        "the points' order and times are not known: each has independent noise by the spec, and errors that they share "
        "(the clock, the turn-on bias) are not in the covariance"
    )
    if points.sigma_rad_per_s is not None:
        own = "the points' own sigma replaces the spec's noise; errors that the points share are not in it"
    sigma = points.sigma_rad_per_s
    if sigma is not None:
        sigma = np.where(between, 0.0, both(sigma)[:-1])
    table = TablePoints(estimation.Executed(line, np.arange(2 * count), between), sigma)
    rows = rows._replace(temperature_c=warm)
    # What the spec omits counts as in the plan, whose points are of one run.
    size = built.model.size, built.model.calibrated
    noise = {name: np.pad(columns[: size[1]], [(0, size[0] - size[1]), (0, 0)]) for name, columns in omitted.items()}
    fitted = fit_of(built, points.unit, Recorded(rows, (own,), table), options)
    return report_of(fitted, [log], points.unit, options, sources or {}, noise, RecordFaults())
