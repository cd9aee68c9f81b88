"""Work handed to other threads, where torch's modes of gradients and numbers of threads begin anew."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def in_present_modes(work: Callable[P, R]) -> Callable[P, R]:
    """Return a function that works as the present thread does, with and without gradients, whatever thread calls it."""
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()
    threads = torch.get_num_threads()

    def work_likewise(*args: P.args, **kwargs: P.kwargs) -> R:
        torch.set_num_threads(threads)  # OpenMP counts them for each thread by itself
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            return work(*args, **kwargs)

    return work_likewise


def do(worker: Executor | None, work: Callable[[], R]) -> Future[R]:
    """Let a worker do something in the present modes, after all that it was given before; without one do it at once."""
    if worker is not None:
        return worker.submit(in_present_modes(work))
    done: Future[R] = Future()
    done.set_result(work())
    return done
