"""From what a run recorded to a log: raw bytes decoded, clocks laid on one another, angles and standstills. No JAX."""
