"""How the command line uses JAX: in float64, and without compiling tomorrow what it compiled today.

The library itself never changes JAX's global switches.
"""

import os
from pathlib import Path


def use_float64() -> None:
    """Switch JAX to float64 and keep compiled programs in the user's cache folder;
    call it before anything is computed.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = cache_folder()
    already = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is not None and already is None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def cache_folder() -> Path | None:
    """`$XDG_CACHE_HOME/gradcal`, or None where it cannot be written: then every run compiles for itself."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = Path(base).expanduser() / "gradcal"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK) else None
