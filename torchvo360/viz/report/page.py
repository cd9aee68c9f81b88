"""The page's one file: the template with its style, its scripts and its content inside.

Nothing in it names another place, and its own policy forbids it to ask for one. Names from outside, such as the
input's, reach it only as JSON that cannot end its element, and as text.
"""

import base64
import html
import json
from pathlib import Path
from typing import Any

from torchvo360.files import atomic_path
from torchvo360.viz.report.content import Content, document
from torchvo360.viz.report.pictures import Picture

TEMPLATE = Path(__file__).parent / "template"

SCRIPTS = ("content.js", "geometry.js", "gl.js", "scene.js", "views.js", "panorama.js", "charts.js", "page.js")
"""In the order in which they build on one another."""

BASE64 = 4 / 3
"""Characters of base64 a byte."""

OVERHEAD = 1_500_000
"""Bytes that a page with a full map and a few thousand frames needs beside its pictures."""


def picture_budget(most_bytes: int) -> int:
    """Return how many bytes of pictures a page of at most this size has room for."""
    return max(0, int((most_bytes - OVERHEAD) / BASE64))


def write_report(path: str | Path, content: Content, *, most_bytes: int = 12_000_000) -> None:
    """Write the page of a run.

    Args:
        path: The file; it appears only when it is complete.
        content: What it shows.
        most_bytes: Pictures are left out, every other one, until the page has no more than this, or no picture.

    Raises:
        InputError: Truth is given, and fewer than three poses have a true one.
        OSError: The file cannot be written.
    """
    shown = document(content)
    room = most_bytes - len(_filled(content.name, shown | {"pictures": []}).encode())
    pictures = _encoded(list(content.pictures))
    while pictures and sum(len(json.dumps(picture)) + 2 for picture in pictures) > room:
        pictures = pictures[::2] if len(pictures) > 1 else []
    with atomic_path(path) as temporary:
        temporary.write_text(_filled(content.name, shown | {"pictures": pictures}), encoding="utf-8")


def _encoded(pictures: list[Picture]) -> list[dict[str, Any]]:
    return [{"index": p.index, "jpeg": base64.b64encode(p.jpeg).decode("ascii")} for p in pictures]


def _filled(title: str, shown: dict[str, Any]) -> str:
    parts = {
        "title": html.escape(title),
        "style": _read("style.css"),
        "content": _safe_json(shown),
        "script": "\n".join(_read(name) for name in SCRIPTS),
    }
    before, *rest = _read("page.html").split("{{")
    pieces = [before]
    for part in rest:  # once, from left to right: what is filled in is never looked at again
        name, _, after = part.partition("}}")
        pieces += [parts[name], after]
    return "".join(pieces)


def _safe_json(value: dict[str, Any]) -> str:
    """Return JSON for inside an HTML script element: nothing in it can end the element or open a comment."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _read(name: str) -> str:
    return (TEMPLATE / name).read_text(encoding="utf-8")
