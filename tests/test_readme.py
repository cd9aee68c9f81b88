"""What the README shows works as it stands there."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["run", "test"])
def test_each_command_is_one_line_that_makes_its_own_environment(name):
    fence = re.search(rf"<!-- command: {name} -->\n+```\n(.*?)```", README, re.DOTALL)
    assert fence is not None
    lines = fence.group(1).splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("python3 -m venv ")


def test_the_example_runs_and_aligns_every_pair(capsys):
    code = re.search(r"```python\n(.*?)```", README, re.DOTALL)
    assert code is not None
    names: dict = {}
    exec(compile(code.group(1), "README.md", "exec"), names)
    result, pairs = names["result"], names["pairs"]
    assert (result.status == int(names["Status"].CONVERGED)).all()
    assert ((result.T_tgt_ref - pairs.T_tgt_ref_true).abs() < 5e-3).all()
    assert "CONVERGED" in capsys.readouterr().out


def test_every_local_link_leads_somewhere():
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (Path(__file__).parents[1] / target).exists(), target
