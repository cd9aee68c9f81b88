"""Reading ahead: the same frames in the same order, errors in their turn, and a thread that ends in every case."""

import itertools
import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data import Frame
from torchvo360.data.images import open_images
from torchvo360.data.prefetch import AHEAD, prefetched
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.settings import CLIPS


def frames(count: int, fault: BaseException | None = None) -> Iterator[Frame]:
    for index in range(count):
        yield Frame(index, index, None, "unreadable")
    if fault is not None:
        raise fault


def readers() -> int:
    return sum(thread.name == "torchvo360-reader" for thread in threading.enumerate())


@pytest.fixture(autouse=True)
def ended():
    yield
    assert readers() == 0


@pytest.mark.parametrize("count", [0, 1, AHEAD, 3 * AHEAD])
@pytest.mark.parametrize("ahead", [1, AHEAD])
def test_all_frames_come_in_order(count: int, ahead: int) -> None:
    with prefetched(frames(count), ahead) as ready:
        assert [frame.index for frame in ready] == list(range(count))


def test_a_video_comes_out_as_without_it() -> None:
    clip = open_images(str(next(CLIPS.glob("*.mp4"))), camera_fit="crop", stop=20)
    with prefetched(clip) as ready:
        first = list(itertools.islice(ready, 2))
        ahead = [*first, *ready]
    plain = list(clip)
    assert [(frame.index, frame.t_ns, frame.problem) for frame in ahead] == [
        (frame.index, frame.t_ns, frame.problem) for frame in plain
    ]
    for one, other in zip(ahead, plain, strict=True):
        assert one.image is not None
        assert other.image is not None
        assert np.array_equal(one.image, other.image)


def test_what_computes_in_torch_gives_the_same_bits_in_the_callers_mode() -> None:
    modes = []

    class Watched(SyntheticSequence):
        def frame(self, index: int) -> Frame:
            modes.append((torch.is_inference_mode_enabled(), torch.get_num_threads()))
            return super().frame(index)

    sequence = Watched(SyntheticConfig(frames=3, width=64, height=32))
    with torch.inference_mode(), prefetched(sequence) as ready:
        ahead = list(ready)
    assert modes == [(True, torch.get_num_threads())] * 3
    for one, other in zip(ahead, sequence, strict=True):
        assert one.image is not None
        assert other.image is not None
        assert np.array_equal(one.image, other.image)


def test_an_error_comes_after_the_frames_before_it() -> None:
    seen: list[int] = []
    with prefetched(frames(2, InputError("the third"))) as ready, pytest.raises(InputError, match="the third"):
        seen.extend(frame.index for frame in ready)
    assert seen == [0, 1]


def test_no_more_is_read_than_may_wait() -> None:
    read = []

    def source() -> Iterator[Frame]:
        for frame in frames(100):
            read.append(frame.index)
            yield frame

    with prefetched(source(), 3) as ready:
        next(ready)
        time.sleep(0.3)
        assert len(read) <= 1 + 3 + 1  # one that is worked on, those that wait, one in the reader's hand


@pytest.mark.parametrize("taken", [0, 1, 10])
def test_leaving_early_ends_the_reading_and_closes_the_source(taken: int) -> None:
    closed = []

    class Source:
        def __iter__(self) -> Iterator[Frame]:
            try:
                yield from frames(10_000)
            finally:
                closed.append(threading.current_thread().name)

    with prefetched(Source()) as ready:
        assert len(list(itertools.islice(ready, taken))) == taken
        time.sleep(0.05)
    assert readers() == 0
    assert closed == ["torchvo360-reader"]


def test_an_error_of_the_caller_ends_the_reading() -> None:
    def caller() -> None:
        with prefetched(frames(10_000)) as ready:
            raise InputError(str(next(ready).index))

    with pytest.raises(InputError, match="0"):
        caller()
    assert readers() == 0


def test_ctrl_c_reaches_a_caller_that_waits() -> None:
    waiting, waited = threading.Event(), threading.Event()

    def slow() -> Iterator[Frame]:
        yield from frames(1)
        waiting.wait(5)
        os.kill(os.getpid(), signal.SIGINT)
        waited.wait(5)

    # A process that a shell put into the background begins with signals ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with prefetched(slow()) as ready:
            next(ready)
            waiting.set()
            with pytest.raises(KeyboardInterrupt):
                next(ready)
            waited.set()
    finally:
        signal.signal(signal.SIGINT, before)
