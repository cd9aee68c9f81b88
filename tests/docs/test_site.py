"""The site builds without a complaint, needs no network to be read, and says of the code what the code says."""

import importlib
import importlib.util
import re
import subprocess
import sys
import tomllib
from dataclasses import fields, is_dataclass
from functools import reduce
from pathlib import Path

import pytest

import torchvo360
from torchvo360.cli.benchmark.plan import BenchConfig
from torchvo360.cli.comparison import EvaluateConfig
from torchvo360.cli.exporting import ExportConfig
from torchvo360.cli.plan_settings import PlanSettings
from torchvo360.settings import RunConfig

ROOT = Path(torchvo360.__file__).parents[1]
DOCS = ROOT / "docs"
SETTINGS = [
    ("evaluate.md", EvaluateConfig),
    ("evaluate.md", BenchConfig),
    ("export.md", ExportConfig),
    ("plan.md", PlanSettings),
]


@pytest.fixture(scope="module")
def reference():
    """The script that writes the configuration reference."""
    spec = importlib.util.spec_from_file_location("reference", DOCS / "reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built."""
    pytest.importorskip("material", reason="mkdocs-material is not installed (extra `docs`)")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_the_configuration_page_is_what_the_code_says(reference):
    page = (DOCS / "configuration.md").read_text(encoding="utf-8")
    assert page == reference.page(), "python docs/reference.py writes it anew"


def test_the_configuration_page_holds_every_key():
    page = (DOCS / "configuration.md").read_text(encoding="utf-8")

    def keys(config, path=""):
        for field in fields(config):
            value = getattr(config, field.name)
            yield from keys(value, f"{path}{field.name}.") if is_dataclass(value) else [f"{path}{field.name}"]

    assert [key for key in keys(RunConfig()) if f"\n| `{key}` | " not in page] == []


@pytest.mark.parametrize(("page", "schema"), SETTINGS, ids=lambda value: getattr(value, "__name__", value))
def test_a_commands_page_has_a_line_for_each_of_its_settings(page, schema):
    lines = re.findall(r"^\| (`.*?) \| ", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE)
    told = {key for cell in lines for key in re.findall(r"`(\w+)`", cell)}
    assert {field.name for field in fields(schema)} <= told


def test_every_page_is_in_the_navigation_once():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    named = re.findall(r": (\S+\.md)$", navigation, re.MULTILINE)
    assert sorted(named) == sorted(page.name for page in DOCS.glob("*.md"))


def test_every_function_that_a_page_names_is_there():
    for page in DOCS.glob("*.md"):
        for name in re.findall(r"`(torchvo360(?:\.\w+)+)`", page.read_text(encoding="utf-8")):
            assert found(name), f"{page.name}: {name}"


def found(name: str) -> bool:
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        try:
            reduce(getattr, parts[cut:], module)
        except AttributeError:
            return False
        return True
    return False


def test_every_file_that_a_page_names_is_there():
    for page in [*DOCS.glob("*.md"), ROOT / "README.md"]:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"`((?:torchvo360|tests|conf|train|docs|benchmarks|examples)/[\w/.]+)`", text):
            assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_equations_are_numbered_without_a_gap_and_each_is_told_where_it_is_in_the_code():
    page = (DOCS / "mathematics.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## (\d)\. (.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
    assert len(sections) == 9
    for section, body in sections:
        numbers = re.findall(r"^    \((\d)\.(\d+)\)", body, re.MULTILINE)
        assert numbers == [(section, str(number)) for number in range(1, len(numbers) + 1)]
        told = body.partition("In the code:")[2]
        assert all(f"({section}.{number})" in told for _, number in numbers), section


def test_the_site_asks_for_nothing_from_the_network(site):
    asked = re.compile(r"<(?:script|img|iframe)[^>]+src=[\"']?(?:https?:)?//|<link[^>]+href=[\"']?(?:https?:)?//[^>]*>")
    for page in site.rglob("*.html"):
        loads = [tag for tag in asked.findall(page.read_text(encoding="utf-8")) if 'rel="canonical"' not in tag]
        assert not loads, f"{page.name}: {loads}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(?:https?:)?//", style.read_text(encoding="utf-8")), style.name


def test_the_site_holds_every_page_and_no_script_of_ours(site):
    assert {page.stem for page in site.glob("*.html")} >= {page.stem for page in DOCS.glob("*.md")}
    assert not list(site.rglob("*.py"))


def test_every_extra_that_a_page_names_exists():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    install = (DOCS / "install.md").read_text(encoding="utf-8").partition("## The commands")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", install, re.MULTILINE)) == set(project["optional-dependencies"])
    for page in [*DOCS.glob("*.md"), ROOT / "README.md"]:
        for named in re.findall(r"'\.\[([\w,]+)\]'|\(extra `(\w+)`\)", page.read_text(encoding="utf-8")):
            assert {*"".join(named).split(",")} <= set(project["optional-dependencies"]), page.name


def test_every_command_that_is_installed_has_its_line():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    install = (DOCS / "install.md").read_text(encoding="utf-8").partition("## The commands")[2]
    assert set(re.findall(r"^\| `([\w-]+)` \|", install, re.MULTILINE)) == set(project["scripts"])
