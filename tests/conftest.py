"""Settings of all tests: one thread, so that sums have one order, and the data that may lie beside the repository."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

SHARED = Path(__file__).parents[1] / ".." / "shared"


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder `shared` beside the repository root."""
    if not SHARED.is_dir():
        pytest.skip("the folder `shared` is not beside the repository")
    return SHARED


@pytest.fixture
def listening() -> Iterator[None]:
    """Ctrl-C is heard, even where the tests run in the background of a shell, which has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
