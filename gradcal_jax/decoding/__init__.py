"""From a run's journal to a log: raw bytes decoded, clocks aligned, angles and standstills. No JAX."""
