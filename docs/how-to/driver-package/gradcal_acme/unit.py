"""ACME's unit sends frames, and is described in the rig file."""

from gradcal_jax.hardware.drivers.listening import FramesConfig

__all__ = ["FramesConfig"]
