"""The nearest right spelling of a word."""

import difflib
from collections.abc import Iterable


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The nearest of the known words, or None where nothing is near."""
    names = list(known)
    folded = {_folded(name): name for name in names}
    if _folded(word) in folded:
        return folded[_folded(word)]
    return next(iter(difflib.get_close_matches(word, names, n=1, cutoff=0.6)), None)


def _folded(word: str) -> str:
    return word.casefold().replace("-", "_").replace(" ", "_")
