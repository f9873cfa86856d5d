"""Prints sentences drawn at random from messages, helps and pages, to be read against the rules for sentences.

python experiments/words/sample.py [SEED] [COUNT]
"""

import ast
import random
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def sentences() -> list[tuple[str, str]]:
    """Every sentence of eight words or more, with its file."""
    found: set[tuple[str, str]] = set()
    for path in sorted((ROOT / "gradcal_jax").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                text = "".join(p.value if isinstance(p, ast.Constant) else "…" for p in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                text = node.value
            else:
                continue
            found |= {(str(path.relative_to(ROOT)), one) for one in _split(text)}
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        text = re.sub(r"```.*?```|^ {4}.*$|^\|.*$", "", path.read_text(encoding="utf-8"), flags=re.S | re.M)
        found |= {(str(path.relative_to(ROOT)), one) for one in _split(text)}
    return sorted(found)


def _split(text: str) -> list[str]:
    parts = (" ".join(part.split()) for part in re.split(r"(?<=[.!?:;])\s|\n\n", text))
    return [part for part in parts if len(part.split()) >= 8 and re.search(r"[a-z]{3}", part)]


if __name__ == "__main__":
    seed, count = [*map(int, sys.argv[1:]), *(0, 50)[len(sys.argv) - 1 :]]
    for name, one in random.Random(seed).sample(sentences(), count):
        print(f"{name}: {one}")
