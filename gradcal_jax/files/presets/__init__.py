"""Commented specs to start from. Sensor figures are typical of a class of devices, of no vendor's."""

from importlib import resources

from gradcal_jax.files.problems import nearest


def names() -> tuple[str, ...]:
    """The presets, in alphabetical order."""
    files = resources.files(__name__).iterdir()
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in files if entry.name.endswith(".toml")))


def text(name: str) -> str:
    """The TOML text of a preset. Raises `ValueError` with the nearest right spelling."""
    known = names()
    if name not in known:
        close = nearest(name, known)
        ending = f'; nearest: "{close}"' if close else f"; known: {', '.join(known)}"
        raise ValueError(f'there is no preset named "{name}"{ending}')
    return (resources.files(__name__) / f"{name}.toml").read_text(encoding="utf-8")


def title(name: str) -> str:
    """The title of a preset."""
    for line in text(name).splitlines():
        if line.startswith("title"):
            return line.split("=", 1)[1].strip().strip('"')
    return ""
