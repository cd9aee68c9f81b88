"""The Python and the YAML on the pages work as they stand there."""

import re
from pathlib import Path

import pytest
import torch
import yaml

import torchvo360

DOCS = Path(torchvo360.__file__).parents[1] / "docs"
PAGES = sorted(DOCS.glob("*.md"))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name)
def test_the_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    names: dict = {"__name__": page.stem}
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), names)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "yaml")], ids=lambda page: page.name)
def test_the_yaml_of_a_page_is_yaml(page):
    for text in blocks(page, "yaml"):
        assert yaml.safe_load(text) is not None


def test_pages_are_there_and_have_snippets():
    assert sum(len(blocks(page, "python")) for page in PAGES) >= 10
