"""Logs of vehicles and robots -> `Log`, without a column map: PX4's ULog, ArduPilot's DataFlash, ROS bags, MCAP.

Each source has its module; `streams` has the common part. The libraries that read the formats come with the extra
`logs`, and are imported when a file of their kind is opened.
"""

from gradcal_jax.records.vehicle.streams import KINDS, is_vehicle_log, read_vehicle_log, read_vehicle_logs

__all__ = ["KINDS", "is_vehicle_log", "read_vehicle_log", "read_vehicle_logs"]
