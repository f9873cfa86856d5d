"""The command line computes in float64; the library itself never changes JAX's global switches."""


def use_float64() -> None:
    """Switch JAX to float64, before anything is computed."""
    import jax

    jax.config.update("jax_enable_x64", True)
