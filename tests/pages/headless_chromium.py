"""What a real headless Chromium makes of a page, in a frame of a stated width."""

import json
import os
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "headless_shell")
# Every run of text that shows, with the box around it (those of pictures, too), and sizes of figures and page.
SCRIPT = """
frame.onload = () => {
  const page = frame.contentDocument, style = (e) => frame.contentWindow.getComputedStyle(e), boxes = [];
  const walker = page.createTreeWalker(page.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const text = node.textContent.trim(), parent = node.parentElement, head = parent.closest('thead');
    if (!text || ['STYLE', 'SCRIPT', 'TITLE'].includes(parent.tagName.toUpperCase())) continue;
    if (style(parent).visibility === 'hidden' || style(parent).display === 'none') continue;
    if (head && style(head).position === 'absolute') continue;
    const range = page.createRange();
    range.selectNodeContents(node);
    const rects = parent.closest('svg') ? [parent.getBoundingClientRect()] : [...range.getClientRects()];
    for (const r of rects) {
      if (r.width > 0 && r.height > 0) boxes.push([text.slice(0, 40), r.left, r.top, r.right, r.bottom]);
    }
  }
  const figures = [...page.querySelectorAll('figure svg')].map((s) => [s.getBoundingClientRect().width,
    s.getBoundingClientRect().height, s.querySelectorAll('text').length]);
  const cells = [...page.querySelectorAll('td')].map((c) => style(c).display), at = page.documentElement;
  const found = {boxes, figures, cells, wide: at.scrollWidth, visible: at.clientWidth};
  document.body.dataset.found = JSON.stringify(found);
};
"""


def browser() -> str | None:
    """The browser: $GRADCAL_BROWSER, or the first of the usual names on the path."""
    named = os.environ.get("GRADCAL_BROWSER")
    return named or next((found for name in NAMES if (found := shutil.which(name))), None)


def measured(page: Path, width: int, *, printed: bool = False) -> dict[str, Any]:
    """What `SCRIPT` finds of a page at a width in CSS pixels, on a screen or as it is `printed`."""
    text = page.read_text(encoding="utf-8")
    if printed:
        text = text.replace("@media screen", "@media not all").replace("@media print", "@media all")
    frame = f'<iframe id="frame" style="border:0; height:900px; width:{width}px" srcdoc="{escape(text)}"></iframe>'
    holder = page.with_name(f"holder-{page.name}")
    holder.write_text(f"<body>{frame}<script>{SCRIPT}</script></body>", encoding="utf-8")
    options = [
        "--headless",
        "--no-sandbox",
        "--virtual-time-budget=30000",
        "--disable-gpu",
        "--hide-scrollbars",
        "--dump-dom",
    ]
    command = [str(browser()), *options, holder.resolve().as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    (found,) = re.findall(r'data-found="([^"]*)"', done.stdout)
    return json.loads(unescape(found))


def overlaps(boxes: list[list[Any]], slack: float = 1.5) -> list[tuple[str, str]]:
    """Pairs of texts whose boxes share more than `slack` pixels both ways."""
    found: list[tuple[str, str]] = []
    ordered = sorted(boxes, key=lambda box: box[2])
    for place, (text, left, top, right, bottom) in enumerate(ordered):
        for other, left2, top2, right2, bottom2 in ordered[place + 1 :]:
            if top2 >= bottom - slack:
                break
            if min(right, right2) - max(left, left2) > slack and min(bottom, bottom2) - max(top, top2) > slack:
                found.append((text, other))
    return found
