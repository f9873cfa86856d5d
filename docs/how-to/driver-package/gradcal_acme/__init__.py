"""Two drivers from outside: an ACME chamber, and ACME's unit, which is a STIM300 under another name."""

from gradcal_jax.hardware.setup import Driver

CHAMBER = Driver("chamber", "gradcal_acme.chamber", "AcmeChamber", "AcmeConfig")
UNIT = Driver("imu", "gradcal_acme.unit", "Stim300Stream", "Stim300Config")
