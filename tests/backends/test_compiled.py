"""What `torch.compile` makes of the kernel is made twice for all sizes; test_linearize holds that it means the same."""

import pytest
import torch
from test_numba import FULL, HUBER, PARTIAL, assert_equal, everything, plain

from torchvo360.backends import backend, compiled, eager, select
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError


@pytest.mark.slow
@pytest.mark.skipif(not compiled.has_compiler(), reason="no C++ compiler")
def test_it_is_compiled_twice_for_panoramas_of_every_size():
    counts = torch._dynamo.utils.counters["stats"]
    before = counts["unique_graphs"]
    with torch.no_grad():
        for B, width in ((1, 128), (1, 160), (1, 100), (3, 128), (5, 110)):
            problem = plain(everything(Equirectangular(width, width // 2), B, 1))
            assert_equal(compiled.linearize(*problem, HUBER), eager.linearize(*problem, HUBER))
    assert counts["unique_graphs"] - before <= 2


def test_it_computes_only_where_it_was_asked_for_and_serves(monkeypatch):
    calls = []
    monkeypatch.setattr(compiled, "has_compiler", lambda: True)
    monkeypatch.setattr(compiled, "linearize", lambda *args, **options: calls.append(options))
    problem = plain(everything(FULL, 1, 1))
    select.linearize(*problem, HUBER)
    assert not calls
    with backend("compiled"):
        select.linearize(*problem, HUBER)
        assert len(calls) == 1
        select.linearize(*plain(everything(PARTIAL, 1, 1)), HUBER)
        select.linearize(problem[0], problem[1], problem[2].requires_grad_(), problem[3], HUBER)
    assert len(calls) == 1


def test_without_a_compiler_it_is_refused_in_one_sentence(monkeypatch):
    monkeypatch.setattr(compiled, "has_compiler", lambda: False)
    with pytest.raises(InputError, match=r"^backend: expected a C\+\+ compiler .* got none\.$"), backend("compiled"):
        pass
