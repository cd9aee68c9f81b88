"""Packed frames: each half is its own camera's image, and a half that is missing costs the other one nothing."""

import numpy as np
import pytest
import torch

from torchvo360.cameras import Equirectangular, Lens, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.data.images import plan_fit
from torchvo360.data.packed import LAYOUTS, PackedImages, half_size, halves
from torchvo360.data.selection import Selection
from torchvo360.data.undistort import undistort

BELOW = torch.eye(4, dtype=torch.float64)
BELOW[1, 3] = 0.2
NOISE = np.random.default_rng(0)
FIRST, SECOND = (NOISE.integers(20, 230, (6, 32, 64, 3), dtype=np.uint8) for _ in range(2))


class Stored:
    """A source of the given images."""

    name, notes = "stored", ["a note"]

    def __init__(self, images: list[np.ndarray | None]) -> None:
        self.images = images

    @property
    def length(self) -> int:
        return len(self.images)

    def size(self, selected: range) -> tuple[int, int] | None:
        image = self.images[selected[0]]
        return None if image is None else (image.shape[1], image.shape[0])

    def read(self, start: int, stop: int | None, every: int):
        for index in range(self.length)[start:stop:every]:
            image = self.images[index]
            yield Frame(index, 1000 * index, image, "unreadable" if image is None else "")


def packed(layout: str, swap: bool = False) -> list[np.ndarray | None]:
    axis = 0 if layout == "top_bottom" else 1
    pairs = zip(FIRST, SECOND, strict=True)
    return [np.concatenate([b, a] if swap else [a, b], axis) for a, b in pairs]


def opened(images: list[np.ndarray | None], layout: str, swap: bool = False, **selection) -> PackedImages:
    view = plan_fit(64, 32, "none", None)
    return PackedImages(Stored(images), Selection(**selection), (view, view), BELOW, layout=layout, swap=swap)


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_half_comes_out_as_it_went_in(layout, swap):
    sequence = opened(packed(layout, swap), layout, swap)
    for repeat in range(2):
        frames = list(sequence)
        assert [frame.index for frame in frames] == list(range(6)), repeat
        for frame in frames:
            (other,) = frame.others
            assert frame.problem == ""
            np.testing.assert_array_equal(frame.image, FIRST[frame.index])
            np.testing.assert_array_equal(other, SECOND[frame.index])
    assert (sequence.length, sequence.name, sequence.notes) == (6, "stored", ["a note"])


def test_the_rig_has_the_first_camera_for_its_body():
    sequence = opened(packed("top_bottom"), "top_bottom")
    assert sequence.camera == Equirectangular(64, 32)
    assert sequence.rig.cameras == (sequence.camera, sequence.camera)
    assert sequence.rig.baseline(1) == pytest.approx(0.2)
    below_second = sequence.rig.T_other_first(1) @ torch.tensor([0, 1.2, 0, 1], dtype=torch.float64)
    torch.testing.assert_close(below_second, torch.tensor([0, 1.0, 0, 1], dtype=torch.float64))


def test_start_stop_and_every_choose_packed_frames():
    sequence = opened(packed("left_right"), "left_right", start=1, stop=6, every=2)
    assert [frame.index for frame in sequence] == [1, 3, 5]
    assert sequence.length == 3


def test_a_black_half_is_missing_and_the_other_one_judged_alone():
    images = packed("top_bottom")
    for index, rows in ((1, slice(32, 64)), (2, slice(0, 32)), (3, slice(0, 64))):
        image = images[index]
        assert image is not None
        image[rows] = 0
    frames = list(opened(images, "top_bottom"))
    assert [frame.problem for frame in frames] == ["", "", "black", "black", "", ""]
    assert [frame.others[0] is None for frame in frames] == [False, True, False, True, False, False]


def test_frames_of_another_size_or_unreadable_ones_have_neither_image():
    images = packed("top_bottom")
    images[1], images[2] = None, images[2][:, :32]  # pyright: ignore[reportOptionalSubscript]
    images[3] = np.concatenate([FIRST[3], SECOND[3]], 1)
    frames = list(opened(images, "top_bottom"))
    assert [frame.problem for frame in frames] == ["", "unreadable", "size", "size", "", ""]
    assert all(frame.image is None and frame.others == (None,) for frame in frames[1:4])


def test_each_half_has_its_own_lens():
    lenses = [Lens(64, 32, focal, focal, 32.0, 16.0, "radtan", (-0.1, 0.0, 0.0, 0.0)) for focal in (50.0, 60.0)]
    first = undistort(lenses[0])
    second = undistort(lenses[1], size=(first.camera.width, first.camera.height))
    images = Stored(packed("left_right"))
    sequence = PackedImages(images, Selection(), (first, second), BELOW, layout="left_right")
    frame = next(iter(sequence))
    assert isinstance(sequence.camera, Pinhole)
    assert sequence.rig.cameras == (first.camera, second.camera)
    np.testing.assert_array_equal(frame.image, first(FIRST[0]))
    np.testing.assert_array_equal(frame.others[0], second(SECOND[0]))


def test_halves_that_do_not_exist_and_cameras_in_one_place_are_refused():
    assert half_size("top_bottom", 64, 64) == (64, 32)
    with pytest.raises(InputError, match=r"^rig\.layout: expected an even height for top_bottom, got .* 64 x 63\.$"):
        half_size("top_bottom", 64, 63)
    with pytest.raises(InputError, match=r"^rig\.layout: expected an even width for left_right, got .* 63 x 64\.$"):
        halves(np.zeros((64, 63, 3), np.uint8), "left_right")
    view = plan_fit(64, 32, "none", None)
    with pytest.raises(InputError, match=r"expected camera 1 apart from the first, got 0 m apart\.$"):
        PackedImages(
            Stored(packed("top_bottom")),
            Selection(),
            (view, view),
            torch.eye(4, dtype=torch.float64),
            layout="top_bottom",
        )
