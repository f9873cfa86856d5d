"""Two drivers from outside: an ACME chamber, and ACME's unit, which sends frames."""

from gradcal_jax.hardware.setup import Driver

CHAMBER = Driver("chamber", "gradcal_acme.chamber", "AcmeChamber", "AcmeConfig")
UNIT = Driver("imu", "gradcal_acme.unit", "ListeningImu", "FramesConfig")
