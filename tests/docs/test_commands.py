"""Every command on a page is one that its program takes; those after `<!-- runs -->` are run.

The others name files that only a reader has: their settings are composed and checked, and nothing is opened.
"""

import ast
import importlib
import importlib.util
import re
import shlex
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

import torchvo360
from torchvo360.cli import comparison, exporting, plan_settings
from torchvo360.cli.benchmark import plan as benchmark_plan
from torchvo360.cli.command import ENVIRONMENT, conf_folder
from torchvo360.cli.configuration import compose

ROOT = Path(torchvo360.__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

FENCE = re.compile(r"^(<!-- runs -->\n+)?^```([a-z]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"\S+=\S+ |(\.venv\S*/bin/)?(torchvo360|python|pytest)")
INLINE = re.compile(r"`(torchvo360(?:-\w+)? [^`]+)`")
BEFORE = re.compile(r"(\w+=\S+ )*(\.venv(-test)?/bin/)?")
"""What may stand before a command: variables of the environment, and where the environment is."""

PROGRAMS = {
    "torchvo360": "torchvo360.cli",
    "torchvo360-eval": "torchvo360.cli.evaluate",
    "torchvo360-bench": "torchvo360.cli.bench",
    "torchvo360-export": "torchvo360.cli.export",
    "torchvo360-plan": "torchvo360.cli.plan",
}

TRAININGS = {"train/features.py": ("features", "FeaturesConfig"), "train/depth.py": ("depth", "DepthTraining")}


class Command(NamedTuple):
    page: str
    runs: bool
    words: list[str]


def commands(page: Path) -> Iterator[Command]:
    """A page's commands: in fences without a language or indented, one a line or joined by &&, and in sentences."""
    text = page.read_text(encoding="utf-8")
    lines = [(bool(fence[1]), line) for fence in FENCE.finditer(text) if not fence[2] for line in fence[3].splitlines()]
    rest = FENCE.sub("", text)
    lines += [(False, line[4:]) for line in rest.splitlines() if re.match(r"    \S", line)]
    lines += [(False, " ".join(span.split())) for span in INLINE.findall(rest)]
    for runs, line in lines:
        for part in line.split(" && "):
            if COMMAND.match(part):
                yield Command(page.name, runs, shlex.split(BEFORE.sub("", part, count=1), comments=True))


ALL = [command for page in PAGES if page.exists() for command in commands(page)]


def of(*programs: str) -> list:
    chosen: dict[str, Command] = {}  # once, however many pages have it
    for command in ALL:
        if command.words[0] in programs:
            chosen.setdefault(shlex.join(command.words), command)
    return [pytest.param(command.words, id=f"{command.page}: {' '.join(command.words)}") for command in chosen.values()]


@pytest.fixture
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


def compose_all(overrides: list[str]) -> None:
    """Compose every job of a sweep."""
    choices = []
    for text in overrides:
        parsed = OverridesParser.create().parse_override(text)
        values = parsed.sweep_string_iterator() if parsed.is_sweep_override() else [None]
        choices.append([text if value is None else f"{parsed.get_key_element()}={value}" for value in values])
    for job in product(*choices):
        compose(job, conf_folder())


@pytest.mark.parametrize("words", of(*PROGRAMS))
@pytest.mark.usefixtures("_elsewhere")
def test_a_command_on_a_page_is_one_that_its_program_takes(words):
    program, words = words[0], [word for word in words[1:] if word not in ("--help", "--cfg")]
    if program == "torchvo360":
        compose_all([word for word in words if word != "-m"]) if "-m" in words else compose(words, conf_folder())
    elif program == "torchvo360-eval":
        assert comparison.parse(words).estimates
    elif program == "torchvo360-bench":
        compose(benchmark_plan.parse(words, conf_folder()).run_overrides, conf_folder())
    elif program == "torchvo360-plan":
        plan_settings.settings_of(words)
    else:
        settings, for_the_run = exporting.settings_of(words)
        compose([f"input={settings.input}", *for_the_run], conf_folder())


@pytest.mark.usefixtures("_elsewhere")
def test_the_commands_of_the_first_run_run_one_after_the_other(tmp_path, capsys):
    to_run = [command.words for command in ALL if command.runs]
    assert {words[0] for words in to_run} >= {"torchvo360", "torchvo360-eval", "torchvo360-export", "torchvo360-plan"}
    for program, *words in to_run:
        code = importlib.import_module(PROGRAMS[program]).main([*words])
        assert code == 0, (program, words, capsys.readouterr().err)
    assert (tmp_path / "runs" / "first" / "report.html").is_file()


@pytest.mark.parametrize("words", of("python"))
def test_a_script_on_a_page_is_there_and_knows_its_options(words):
    arguments = words[1:]
    if arguments[0] == "-m":
        assert importlib.util.find_spec(arguments[1]) is not None
        return
    script = ROOT / arguments[0]
    known = {node.value for node in ast.walk(ast.parse(script.read_text())) if isinstance(node, ast.Constant)}
    for option in filter(re.compile("--").match, arguments):
        assert option in known, option


@pytest.mark.parametrize("words", [case for case in of("python") if case.values[0][1] in TRAININGS])
def test_a_training_on_a_page_takes_its_settings(words):
    name, schema = TRAININGS[words[1]]
    settings = importlib.import_module("settings")
    settings.compose(name, getattr(importlib.import_module(name), schema), words[2:], conf_folder() / "train")


@pytest.mark.parametrize("words", of("pytest"))
def test_what_a_page_tests_is_there(words):
    for path in [word for word in words[1:] if word.startswith("tests")]:
        assert (ROOT / path).exists(), path


def test_every_program_is_named_on_the_pages():
    assert {command.words[0] for command in ALL} >= set(PROGRAMS)
