"""ACME's unit speaks as a STIM300 does."""

from gradcal_jax.hardware.drivers.stim300 import Stim300Config, Stim300Stream, decoder_of

__all__ = ["Stim300Config", "Stim300Stream", "decoder_of"]
