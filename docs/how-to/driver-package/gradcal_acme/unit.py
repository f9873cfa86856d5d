"""ACME's unit sends frames, and is described in the rig file."""

from gradcal_jax.hardware.drivers.frames import FramesConfig, FramesStream, decoder_of

__all__ = ["FramesConfig", "FramesStream", "decoder_of"]
