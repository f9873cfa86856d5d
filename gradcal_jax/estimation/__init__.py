"""From readings to parameters with covariance, by the measurement model of the prediction."""

from gradcal_jax.estimation.alignment_check import CoarseFit, coarse_fits
from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.gravity_angles import angles_by_gravity
from gradcal_jax.estimation.imu_executed import executed_imu
from gradcal_jax.estimation.imu_readings import ImuReadings, readings_counted, readings_of
from gradcal_jax.estimation.imu_rows import ExecutedImu, ImuRows
from gradcal_jax.estimation.imu_solve import ImuEstimate, Whitened, angle_errors, solve_imu
from gradcal_jax.estimation.plateaus import TablePoints, motion_at_points, plateaus
from gradcal_jax.estimation.read_motion import column_readings, motion_by_readings, standing_with, within
from gradcal_jax.estimation.standstill import find_standstills, lost_in_moves, settling
from gradcal_jax.estimation.temperature import smoothed_temperature
