"""`gradcal glossary`: the words that commands, files and pages use."""

from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import columns


def glossary(*term: str) -> int:
    """Explain the words that commands, files and pages use.

    Parameters
    ----------
    term
        Only terms with these words in them; all, without it.
    """
    from gradcal_jax.pages.glossary import TERMS

    wanted = " ".join(term).lower()
    rows = [
        (name, meaning)
        for name, meaning in sorted(TERMS.items(), key=lambda entry: entry[0].lower())
        if wanted in name.lower()
    ]
    if not rows:
        raise ValueError(f'the glossary has no term with "{wanted}" in it; gradcal glossary lists all of them')
    print(columns(rows, indent=""))
    return DONE
