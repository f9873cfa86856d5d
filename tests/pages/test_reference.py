"""The reference of every format is what the generator makes, whole, and leads somewhere."""

import json
import re
from pathlib import Path

import pytest

from gradcal_jax.cli import main
from gradcal_jax.pages.reference import reference
from gradcal_jax.tables import schemas

FOLDER = Path(__file__).parents[2] / "docs" / "reference"


@pytest.fixture(scope="module")
def made():
    return {name: reference(name) for name in schemas.schema_names()}


def test_the_committed_pages_are_what_the_generator_makes(made):
    assert {page.stem for page in FOLDER.glob("*.md")} == {*made, "commands", "features"}
    for name, text in made.items():
        again = f"gradcal schema {name} --markdown > docs/reference/{name}.md"
        assert (FOLDER / f"{name}.md").read_text(encoding="utf-8") == text, again


def _tables(name):
    whole = schemas.schema(name)
    return {whole["title"]: whole, **whole.get("$defs", {})}


@pytest.mark.parametrize("name", schemas.schema_names())
def test_every_key_has_a_meaning_and_a_row(name, made):
    everything = "\n".join(made.values())
    for title, table in _tables(name).items():
        for key, entry in table.get("properties", {}).items():
            assert re.match(r"[A-Z0-9\"\[].*\.$", entry.get("description", "")), f"{title}.{key} has no meaning"
            assert f"| `{key}` |" in everything, f"{title}.{key}"


def test_a_key_stands_with_its_default_values_and_meaning(made):
    row = next(line for line in made["spec"].splitlines() if line.startswith('| `cycles` | `"own"'))
    meaning = schemas.schema("spec")["$defs"]["Design"]["properties"]["cycles"]["description"]
    assert row == f'| `cycles` | `"own"`, `"alike"` | `"own"` | {meaning} |'
    assert '| `max_rate` | such as `"10 deg/s"` | required |' in made["spec"]


def test_every_link_leads_to_a_heading(made):
    def headings(text):
        return {line[3:].lower().replace(" ", "-") for line in text.splitlines() if line.startswith("## ")}

    links = [(name, *link) for name, text in made.items() for link in re.findall(r"\]\(([^#)]*)#([^)]*)\)", text)]
    assert len(links) > 100
    for name, page, heading in links:
        assert heading in headings(made[page.removesuffix(".md") or name]), (name, page, heading)


def test_a_missing_key_is_said_with_its_meaning(tmp_path, capsys):
    spec = tmp_path / "spec.toml"
    assert main(["new", "tactical-mems", "-o", str(spec)]) == 0
    text = spec.read_text(encoding="utf-8")
    spec.write_text(re.sub(r"(?m)^max_rate .*\n", "", text), encoding="utf-8")
    assert main(["check", str(spec)]) == 2
    assert "rig.table.axis[0].max_rate: this key is missing (largest rate)" in capsys.readouterr().err


def test_the_command_prints_the_page(made, capsys):
    assert main(["schema", "rig", "--markdown"]) == 0
    assert capsys.readouterr().out == made["rig"]
    assert main(["schema", "rig"]) == 0
    assert json.loads(capsys.readouterr().out)["$id"] == "gradcal-rig/1"
