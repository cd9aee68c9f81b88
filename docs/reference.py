"""Write docs/configuration.md: every setting with its default and its explanation, read from the dataclasses.

Run from the root of the repository after a setting has changed:

    python docs/reference.py

A test holds the page equal to what this file makes of the code.
"""

import ast
import html
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from torchvo360 import AlignConfig
from torchvo360.settings import RunConfig

DOCS = Path(__file__).parent
PAGE = DOCS / "configuration.md"
PRESETS = DOCS.parent / "conf" / "vo"

HEAD = """# Configuration

Every key of `torchvo360`, with its default and what it means. `key=value` on the command line changes one:

    torchvo360 input=walk.mp4 vo.map.points=1200 vo.window.keyframes=9

`torchvo360 --cfg` prints them all with their values. The keys are those of the dataclass `RunConfig`
(`torchvo360/settings.py`) and of the dataclasses in it; in Python each part is made by its own name, such as
`OdometryConfig(map=MapConfig(points=1200))`. This page is made from their source by `docs/reference.py`.
"""

PRESETS_HEAD = """
## Presets of the odometry

`vo=NAME` takes a file of `conf/vo`, which says only what differs from the defaults below; keys on the command line go
before it.
"""

LAYER_HEAD = """
## Of the alignment layer

`AlignConfig` holds the settings of `align` and `Align` in Python ([The alignment layer](layer.md)); the command's own
alignments have theirs under `vo`.
"""


def page() -> str:
    """Return the whole page."""
    parts = [HEAD, *_sections(RunConfig(), "", "A run"), PRESETS_HEAD, *_presets()]
    return "".join([*parts, LAYER_HEAD, *_sections(AlignConfig(), "", "AlignConfig", level=3)])


def explanations(config_type: type) -> dict[str, str]:
    """Return what stands beneath each field of a dataclass, by the field's name."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(config_type))).body
    assert isinstance(tree, ast.ClassDef)
    told: dict[str, str] = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                told[name] = inspect.cleandoc(words).replace("\n", " ")
    return told


def _sections(config: Any, path: str, title: str, level: int = 2) -> Iterator[str]:
    """Yield a section for a dataclass, and then those for the dataclasses in it."""
    told, inner, rows = explanations(type(config)), [], []
    for field in fields(config):
        value, key = getattr(config, field.name), f"{path}{field.name}"
        if is_dataclass(value) and not isinstance(value, type):
            inner.append((value, key))
        else:
            rows.append(f"| `{key}` | {_default(value)} | {_text(told.get(field.name, ''))} |\n")
    about = _text((inspect.getdoc(type(config)) or "").partition("\n\n")[0].replace("\n", " "))
    yield f"\n{'#' * level} {title}\n\n{about}\n"
    if rows:
        yield "".join(["\n| key | default | |\n| --- | --- | --- |\n", *rows])
    for value, key in inner:
        yield from _sections(value, f"{key}.", f"`{key}`", level)


def _presets() -> Iterator[str]:
    for file in sorted(PRESETS.glob("*.yaml")):
        yield f"\n`vo={file.stem}`:\n\n```yaml\n{file.read_text(encoding='utf-8')}```\n"


def _default(value: object) -> str:
    """Return a value as it is written on the command line."""
    if isinstance(value, list):
        return f"`[{','.join(map(str, value))}]`"
    if value is None or isinstance(value, bool):
        return f"`{json.dumps(value)}`"
    return f"`{value:.6g}`" if isinstance(value, float) else f"`{value}`"


def _text(words: str) -> str:
    """Return words as Markdown's plain text: what stands between backticks is left alone, but for the table's bars."""
    pieces = words.split("`")
    pieces[::2] = [re.sub(r"([*_\[\]])", r"\\\1", html.escape(piece, quote=False)) for piece in pieces[::2]]
    return "`".join(pieces).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
