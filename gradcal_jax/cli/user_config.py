"""The user's configuration file, ~/.config/gradcal/config.toml; imports are late, for the sake of `gradcal --help`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cyclopts import App

    from gradcal_jax.spec.user_config import UserConfig


def config_path() -> Path | None:
    """Path of the user's configuration: the value of the environment variable `GRADCAL_CONFIG` (empty: None); if it is
    not set, gradcal/config.toml in the XDG configuration folder, or None if that file does not exist."""
    if (named := os.environ.get("GRADCAL_CONFIG")) is not None:
        return Path(named) if named else None
    path = Path(os.environ.get("XDG_CONFIG_HOME") or "~/.config").expanduser() / "gradcal" / "config.toml"
    return path if path.exists() else None


def read_user_config() -> "UserConfig":
    """The user's configuration; empty without a file. Raises `SpecError`."""
    from gradcal_jax.spec.user_config import FORMAT, UserConfig
    from gradcal_jax.tables.document import parsed, read_text

    path = config_path()
    return UserConfig() if path is None else parsed(UserConfig, read_text(path), FORMAT, str(path))


def own_defaults(app: "App") -> Any:
    """The defaults of options, as `App.config` takes them. Raises `ValueError` for an unknown command."""
    if (path := config_path()) is None:
        return ()
    from cyclopts.config import Dict

    from gradcal_jax.tables.problems import hint

    defaults = read_user_config().defaults
    for name in defaults:
        if name not in app:
            raise ValueError(f"{path}: defaults.{name}: there is no such command{hint(name, app)}")
    return (Dict(dict(defaults), source=str(path)),)


def rig_or_own(rig: Path | None, missing: str = "name the rig file") -> Path:
    """The rig file of a command line, or else the user's. Raises `ValueError` if there is none."""
    if rig is None and (path := config_path()) is not None and (own := read_user_config().rig) is not None:
        return path.parent / Path(own).expanduser()
    if rig is None:
        raise ValueError(f'{missing}, or set rig = "…" in ~/.config/gradcal/config.toml')
    return rig
