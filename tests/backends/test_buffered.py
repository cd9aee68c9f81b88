"""In buffers the eager kernel gives the very bits that it gives in fresh tensors, from every thread and mode."""

import threading
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from test_numba import CAMERAS, FULL, HUBER, LOSSES, Problem, everything, plain

from torchvo360.backends import buffered, eager
from torchvo360.residuals.normal import NormalEquations


def fresh(monkeypatch: pytest.MonkeyPatch, call: Callable[[], NormalEquations]) -> NormalEquations:
    with monkeypatch.context() as patch, torch.no_grad():
        patch.setattr(buffered, "serves", lambda *_: False)
        return call()


def assert_same_bits(found: NormalEquations, truth: NormalEquations) -> None:
    for a, b in zip(found, truth, strict=True):
        assert torch.equal(a, b)


@CAMERAS
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("loss", LOSSES[:3], ids=lambda loss: f"{loss.name} {loss.cutoff}")
def test_every_option_gives_the_same_bits(monkeypatch, camera, channels, loss):
    for problem in (everything(camera, 3, channels, shared=False), plain(everything(camera, 1, channels))):
        for dtype in (torch.float32, torch.float64):
            args = in_dtype(problem, dtype)
            assert_same_bits(
                eager.linearize(*args, loss), fresh(monkeypatch, lambda args=args: eager.linearize(*args, loss))
            )


def in_dtype(problem: Problem, dtype: torch.dtype) -> Problem:
    reference, target, T, affine = problem

    def of(value):
        return value.to(dtype) if isinstance(value, torch.Tensor) else value

    fields = ("ray", "rho", "value", "weight", "variance")
    points = replace(reference, **{name: of(getattr(reference, name)) for name in fields})
    images = {name: of(getattr(target, name)) for name in ("padded", "confidence", "intrinsics")}
    return points, replace(target, **images), T, affine


@pytest.mark.parametrize("count", [0, 1, 15, 4097])
def test_any_number_of_points_and_an_answer_that_stays(monkeypatch, count):
    reference, target, T, affine = everything(FULL, 2, 1)
    problem = reference.chunk(2000, 2000 + count), target, T, affine
    found = eager.linearize(*problem, HUBER)
    kept = [part.clone() for part in found]
    eager.linearize(problem[0], target, T.flip(0), affine, HUBER)  # in the same buffers
    assert_same_bits(found, NormalEquations(*kept))
    assert_same_bits(found, fresh(monkeypatch, lambda: eager.linearize(*problem, HUBER)))


def test_buffers_of_inference_mode_serve_outside_of_it():
    buffered._kept.rooms.clear()
    problem = plain(everything(FULL, 1, 1))
    with torch.inference_mode():
        inside = eager.linearize(*problem, HUBER)
    assert_same_bits(eager.linearize(*problem, HUBER), inside)


def test_threads_do_not_share_buffers():
    problems = [plain(everything(FULL, B, 1)) for B in (1, 2, 1, 2)]
    truth = [eager.linearize(*problem, HUBER) for problem in problems]
    wrong: list[int] = []

    def work(k: int) -> None:
        for _ in range(20):
            if not torch.equal(eager.linearize(*problems[k], HUBER).H, truth[k].H):
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_thread_keeps_few_sizes():
    reference, target, T, affine = plain(everything(FULL, 1, 1))
    for count in range(100, 120):
        eager.linearize(reference.chunk(0, count), target, T, affine, HUBER)
    assert len(buffered._kept.rooms) <= buffered.ROOMS
