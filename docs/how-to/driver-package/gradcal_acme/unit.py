"""ACME's unit sends frames, and is described in the rig file."""

from gradcal_jax.hardware.drivers.frames import FramesConfig, ListeningImu

__all__ = ["FramesConfig", "ListeningImu"]
