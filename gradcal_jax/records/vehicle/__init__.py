"""Logs of vehicles -> `Log`, without a column map: PX4's ULog and ArduPilot's DataFlash.

Each source has its module; `streams` has the common part. The libraries that read the formats come with the extra
`logs`, and are imported when a file of their kind is opened.
"""

from gradcal_jax.records.vehicle.streams import KINDS, is_vehicle_log, read_vehicle_log, read_vehicle_logs

__all__ = ["KINDS", "is_vehicle_log", "read_vehicle_log", "read_vehicle_logs"]
