"""What the README shows works as it stands there."""

import re
import runpy
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["run", "test"])
def test_each_command_is_one_line_that_makes_its_own_environment(name):
    fence = re.search(rf"<!-- command: {name} -->\n+```\n(.*?)```", README, re.DOTALL)
    assert fence is not None
    lines = fence.group(1).splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("python3 -m venv ")


def test_the_examples_run_one_after_the_other(capsys):
    codes = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(codes) == 2
    names: dict = {}
    exec(compile(codes[0], "README.md", "exec"), names)
    result, pairs = names["result"], names["pairs"]
    assert (result.status == int(names["Status"].CONVERGED)).all()
    assert ((result.T_tgt_ref - pairs.T_tgt_ref_true).abs() < 5e-3).all()
    assert "CONVERGED" in capsys.readouterr().out
    torch.manual_seed(0)
    exec(compile(codes[1], "README.md", "exec"), names)
    assert names["result"].differentiable.any()
    assert all(p.grad.abs().max() > 0 for p in names["model"].parameters())


@pytest.mark.parametrize("script", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_an_example_runs(script, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [str(script)])
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.name
)
def test_every_local_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+)[^):]*\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_one_command_makes_a_report_of_a_video_and_stands_on_the_first_screen():
    before, command = README.split("torchvo360 input=walk.mp4\n")[:2]
    assert before.count("\n") < 45
    assert "report.html" in command.split("\n\n")[0] + command.split("\n\n")[1]
