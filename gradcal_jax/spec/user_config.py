"""`gradcal-config/1`: what a user sets once for all commands: laboratory, rig, and defaults of options."""

from collections.abc import Mapping
from typing import Any, Final, Literal

from pydantic import Field

from gradcal_jax.spec.rig import Laboratory
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-config/1"


class UserConfig(Section):
    """The configuration of a user. Options on the command line, and entries of a rig file, take precedence over it."""

    format: Literal["gradcal-config/1"] = FORMAT
    """Name and version of this file format."""
    laboratory: Laboratory | None = None
    """The laboratory that signs a certificate, if the rig file has no `[laboratory]`."""
    rig: Text | None = None
    """The default rig file of `gradcal run`, `rig check` and `rig record`, relative to this file."""
    defaults: Mapping[str, Any] = Field(default_factory=dict[str, Any])
    """Options by command, such as `run = { operator = "A. Person" }`; the command line takes precedence."""
