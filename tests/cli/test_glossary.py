"""Every technical word of the help texts is one that `gradcal schema words` explains.

A word is technical unless it stands in `everyday_words.txt`: English that a reader needs no glossary for, the names of
other programs and of file formats among it. A word that is new to the help texts has to go into one of the two.
"""

import re
from pathlib import Path

import pytest

from gradcal_jax.cli import main
from gradcal_jax.cli.app import build
from gradcal_jax.pages.glossary import OF_THE_FIELD, OF_THE_PROGRAM, TERMS

EVERYDAY = set((Path(__file__).parent / "everyday_words.txt").read_text(encoding="utf-8").split())
COMMANDS = [name for name in build() if not name.startswith("-")]
# What the help itself is set with, and how it writes quantities.
NOTATION = re.compile(
    r"\[(required|default: [^\]]*|choices: [^\]]*|OPTIONS|ARGS\.*)\]|\b(STR|INT|FLOAT|PATH|CHOICE)\b|"
    r"\"[^\"]*\"|`[^`]*`|\S+\.(toml|npz|nc|json|html|csv|md)\b|gradcal-[\w-]+/\d|tcp://\S+|"
    r"[\d.]+ ?[A-Za-z%/]+|\b[QNBK]\b"
)


def words_of(text: str) -> set[str]:
    """Words as they stand, in small letters; options are taken apart at their hyphens."""
    plain = NOTATION.sub(" ", text)
    plain = re.sub(r"--[\w-]+", lambda option: option[0].replace("-", " "), plain)
    return {word.lower() for word in re.findall(r"[A-Za-z]+(?:-[A-Za-z]+)*", plain) if len(word) > 1}


def forms(word: str) -> set[str]:
    """A word and what it may be a form of: plurals, and what is done, doing or done with."""
    found = {word}
    for ending, base in (("s", ""), ("es", ""), ("ies", "y"), ("ed", ""), ("ed", "e"), ("ing", ""), ("ing", "e")):
        if word.endswith(ending):
            found.add(word[: -len(ending)] + base)
    return found


HEADS = {
    word for term in TERMS for word in [term.lower(), term.lower().replace(" ", "-"), *re.split(r"[ -]", term.lower())]
}
EXPLAINED = {form for head in HEADS for form in forms(head)} | {"axes"}


def unexplained(text: str) -> set[str]:
    return {word for word in words_of(text) if not forms(word) & (EXPLAINED | EVERYDAY)}


@pytest.mark.parametrize("command", [*COMMANDS, "rig new", "rig check", "log turns"])
def test_the_glossary_has_every_technical_word_of_a_help_text(command, capsys):
    assert main([*command.split(), "--help"]) == 0
    assert unexplained(capsys.readouterr().out) == set()


def test_a_technical_word_that_nobody_explains_is_found():
    text = 'Parameters:\n  --jerk STR: The derivative of the angle, such as "5 deg/s^3". [default: 0]'
    assert unexplained(text) == {"jerk", "derivative"}
    assert unexplained("Draws quaternions by Cholesky.") == {"quaternions", "cholesky"}


def test_no_word_is_both_everyday_and_explained():
    """Otherwise a term could leave the glossary unnoticed."""
    heads = {term.lower() for term in TERMS if " " not in term}
    assert {word for word in EVERYDAY if forms(word) & heads} == set()


def test_each_term_is_explained_once_in_a_sentence():
    assert not set(OF_THE_FIELD) & set(OF_THE_PROGRAM)
    for term, meaning in TERMS.items():
        assert meaning.endswith((".", ".)")), term
        assert 4 <= len(meaning.split()) <= 30, term


def test_every_command_is_explained_or_everyday():
    assert {name for name in COMMANDS if not forms(name) & (EXPLAINED | EVERYDAY)} == set()
