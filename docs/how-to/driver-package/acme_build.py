"""Builds the wheel of this package from its pyproject.toml (PEP 517), with nothing but the standard library."""

import tomllib
import zipfile
from pathlib import Path


def build_wheel(wheel_directory: str, config_settings: object = None, metadata_directory: object = None) -> str:
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    name = f"{project['name'].replace('-', '_')}-{project['version']}"
    groups = project["entry-points"].items()
    entries = "\n".join(
        line for group, names in groups for line in (f"[{group}]", *(f"{k} = {v}" for k, v in names.items()))
    )
    info = {
        "METADATA": f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n",
        "WHEEL": "Wheel-Version: 1.0\nGenerator: acme_build\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        "entry_points.txt": entries + "\n",
    }
    files = {str(path): path.read_bytes() for path in sorted(Path("gradcal_acme").glob("*.py"))}
    files |= {f"{name}.dist-info/{part}": text.encode() for part, text in info.items()}
    record = "".join(f"{path},,\n" for path in (*files, f"{name}.dist-info/RECORD"))
    with zipfile.ZipFile(Path(wheel_directory) / f"{name}-py3-none-any.whl", "w") as wheel:
        for path, data in {**files, f"{name}.dist-info/RECORD": record.encode()}.items():
            wheel.writestr(path, data)
    return f"{name}-py3-none-any.whl"
