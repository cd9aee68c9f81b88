from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchvo360.cameras import Equirectangular, Lens
from torchvo360.checks import InputError
from torchvo360.data.images import Images, open_images, open_source, plan_fit
from torchvo360.data.selection import Selection
from torchvo360.data.undistort import undistort

SHARED = Path(__file__).parents[2] / ".." / "shared"


def texture(index: int, width: int = 64, height: int = 32) -> np.ndarray:
    """A smooth colour image, RGB, with a red bar in the column, of 64, that has the frame's number."""
    v, u = np.mgrid[:height, :width]
    red = 60 + 140 * np.exp(-((((u + 0.5) / width * 64 - index - 0.5) / 2) ** 2))
    green = 128 + 60 * np.sin(u / width * 2 * np.pi)
    blue = 128 + 60 * np.cos(v / height * np.pi)
    return np.stack([red, green, blue], -1).round().astype(np.uint8)


def write_image(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image[..., ::-1])


def write_folder(folder: Path, count: int = 12, suffix: str = ".png", **size: int) -> Path:
    folder.mkdir(exist_ok=True)
    for index in range(count):
        write_image(folder / f"frame{index}{suffix}", texture(index, **size))
    return folder


def write_video(path: Path, count: int = 40, fps: float = 25, width: int = 64, height: int = 32) -> Path:
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v")), fps, (width, height)
    )
    assert writer.isOpened()
    for index in range(count):
        writer.write(np.ascontiguousarray(texture(index, width, height)[..., ::-1]))
    writer.release()
    return path


def frame_number(image: np.ndarray) -> int:
    """The frame that `texture` drew, through lossy coding."""
    return int(np.median(image[..., 0], 0).argmax())


def open_path(path: Path, **options) -> Images:
    return open_images(str(path), **options)


# folders and patterns


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPEG", ".bmp", ".tif", ".webp"])
def test_a_folder_is_read_in_natural_order_as_rgb(tmp_path, suffix):
    folder = write_folder(tmp_path / "room", suffix=suffix)
    (folder / "notes.txt").write_text("not an image")
    (folder / "sub.png").mkdir()
    images = open_path(folder)
    assert (images.name, images.length, images.truth) == ("room", 12, None)
    assert images.camera == Equirectangular(64, 32)
    frames = list(images)
    assert [frame.index for frame in frames] == list(range(12))
    assert [frame.t_ns for frame in frames] == [round(index * 1e9 / 30) for index in range(12)]
    for frame in frames:
        assert frame.problem == ""
        assert frame.image is not None
        assert frame.image.dtype == np.uint8
        assert np.abs(frame.image.astype(int) - texture(frame.index)).mean() < (0.01 if suffix == ".png" else 4)


def test_a_sequence_can_be_iterated_again_and_twice_at_once(tmp_path):
    images = open_path(write_folder(tmp_path / "room"))
    first, second = iter(images), iter(images)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
    assert len(list(images)) == 12


def test_files_are_read_only_when_their_turn_comes(tmp_path):
    folder = write_folder(tmp_path / "room")
    frames = iter(open_path(folder))
    next(frames)
    (folder / "frame7.png").unlink()
    assert [frame.problem for frame in frames] == [""] * 6 + ["unreadable"] + [""] * 4


def test_a_pattern_takes_what_it_matches(tmp_path):
    folder = write_folder(tmp_path / "room")
    (folder / "frame1.txt").write_text("not an image")
    images = open_images(str(folder / "frame1*"))
    assert images.name == "room"
    assert [frame_number(frame.image) for frame in images if frame.image is not None] == [1, 10, 11]
    write_folder(tmp_path / "hall", 3)
    both = open_images(str(tmp_path / "*" / "*.png"))
    assert both.length == 15
    numbers = [frame_number(frame.image) for frame in both if frame.image is not None]
    assert numbers == [*range(3), *range(12)]  # folder by folder


def test_a_folder_with_brackets_in_its_name_is_no_pattern(tmp_path):
    assert open_path(write_folder(tmp_path / "room [2]")).length == 12


@pytest.mark.parametrize(
    ("start", "stop", "every"), [(0, None, 1), (3, None, 2), (1, 8, 3), (0, 100, 5), (10, None, 1)]
)
@pytest.mark.parametrize("kind", ["folder", "video"])
def test_start_stop_and_every_select_as_a_slice_and_keep_index_and_time(tmp_path, kind, start, stop, every):
    path = write_folder(tmp_path / "room") if kind == "folder" else write_video(tmp_path / "room.avi", 12)
    everything = list(open_path(path))
    chosen = open_path(path, start=start, stop=stop, every=every)
    expected = everything[start:stop:every]
    assert chosen.length == len(expected)
    assert [(f.index, f.t_ns) for f in chosen] == [(f.index, f.t_ns) for f in expected]
    for frame in chosen:
        np.testing.assert_array_equal(frame.image, everything[frame.index].image)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("grey", [False, True])
def test_arrays_are_images_too(tmp_path, dtype, grey):
    for index in range(3):
        image = texture(index)[..., 1] if grey else texture(index)
        np.save(tmp_path / f"{index}.npy", image if dtype == np.uint8 else (image / 255).astype(dtype))
    for frame in open_path(tmp_path):
        expected = texture(frame.index)
        np.testing.assert_array_equal(frame.image, expected[..., 1:2].repeat(3, -1) if grey else expected)


def test_pickled_arrays_are_not_loaded(tmp_path):
    for index in range(3):
        np.save(tmp_path / f"{index}.npy", texture(index))
    np.save(tmp_path / "1.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "2.npy", texture(2).astype(np.int64))
    assert [frame.problem for frame in open_path(tmp_path)] == ["", "unreadable", "unreadable"]


# videos


@pytest.mark.parametrize("name", ["walk.avi", "walk.mp4"])
def test_a_video_gives_its_frames_and_times(tmp_path, name):
    images = open_path(write_video(tmp_path / name))
    assert (images.name, images.length) == ("walk", 40)
    frames = list(images)
    assert [frame.t_ns for frame in frames] == [index * 40_000_000 for index in range(40)]
    assert [frame_number(frame.image) for frame in frames if frame.image is not None] == list(range(40))
    assert images.notes == []


def test_fps_replaces_the_times_of_a_video_and_of_a_folder(tmp_path):
    video = open_path(write_video(tmp_path / "walk.avi", 5), fps=10)
    folder = open_path(write_folder(tmp_path / "room", 5), fps=10)
    for images in (video, folder):
        assert [frame.t_ns for frame in images] == [index * 100_000_000 for index in range(5)]


def test_a_truncated_video_ends_where_its_frames_end_and_says_so(tmp_path):
    path = write_video(tmp_path / "walk.avi", 40)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    images = open_path(path)
    assert images.length == 40
    frames = list(images)
    assert 10 < len(frames) < 30
    numbers = [frame_number(frame.image) for frame in frames if frame.image is not None]
    assert numbers[:-1] == list(range(len(frames) - 1))  # the cut goes through the last one
    assert list(images)
    assert images.notes == [f"walk.avi: expected 40 frames, could read {len(frames)}."]


class DamagedCapture:
    """A video of 64 x 32 whose decoder fails at the given frames, with the given header and time stamps."""

    count, promised, fps, failing, times_ms = 40, 40.0, 25.0, frozenset[int](), None

    def __init__(self, path: str) -> None:
        self.position = -1

    def isOpened(self) -> bool:
        return True

    def release(self) -> None: ...

    def grab(self) -> bool:
        self.position += 1
        return self.position < self.count and self.position not in self.failing

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.ascontiguousarray(texture(self.position)[..., ::-1])

    def get(self, prop: int) -> float:
        if prop == cv2.CAP_PROP_POS_MSEC:
            return 40.0 * self.position if self.times_ms is None else self.times_ms[self.position]
        return {cv2.CAP_PROP_FRAME_COUNT: self.promised, cv2.CAP_PROP_FPS: self.fps}[prop]


@pytest.fixture
def capture(monkeypatch, tmp_path):
    """Return a function that opens a video with a damaged file's behaviour."""

    def opened(**behaviour) -> Images:
        monkeypatch.setattr(cv2, "VideoCapture", type("Capture", (DamagedCapture,), behaviour))
        (tmp_path / "walk.mp4").touch()
        return open_path(tmp_path / "walk.mp4")

    return opened


@pytest.mark.parametrize("failing", [{7}, {0, 1}, set(range(10, 30))])
def test_frames_that_cannot_be_decoded_are_marked_and_the_later_ones_keep_their_places(capture, failing):
    images = capture(failing=failing)
    frames = list(images)
    assert [frame.index for frame in frames] == list(range(40))
    assert [frame.t_ns for frame in frames] == [index * 40_000_000 for index in range(40)]
    assert {frame.index for frame in frames if frame.problem == "unreadable"} == failing
    assert all(frame_number(frame.image) == frame.index for frame in frames if frame.image is not None)
    assert images.notes == []


def test_frames_missing_at_the_end_are_not_made_up(capture):
    images = capture(failing=frozenset(range(35, 40)))
    assert [frame.index for frame in images] == list(range(35))
    assert images.notes == ["walk.mp4: expected 40 frames, could read 35."]


@pytest.mark.parametrize("promised", [0.0, -1.0, float("nan"), float("inf")])
def test_a_header_without_a_count_leaves_the_length_unknown(capture, promised):
    images = capture(promised=promised)
    assert images.length is None
    assert len(list(images)) == 40


def test_more_frames_than_promised_are_read(capture):
    assert len(list(capture(promised=30.0))) == 40


@pytest.mark.parametrize("fps", [0.0, 90000.0, float("nan")])
def test_a_header_without_a_rate_is_told_to_the_user(capture, fps):
    images = capture(fps=fps, times_ms=[0.0] * 40)
    assert [frame.t_ns for frame in images] == [index * 33_333_333 for index in range(40)]
    assert images.notes == ["walk.mp4: its header holds no frame rate; 30 is assumed (fps= sets it)."]


def test_uneven_times_are_kept_and_repeated_or_earlier_ones_are_moved_on(capture):
    even = [40.0 * index for index in range(40)]
    times = even.copy()
    times[10] = 390.0
    assert [f.t_ns for f in capture(times_ms=times)] == [round(t * 1e6) for t in times]
    times[20] = times[19]
    times[30] = 0.0
    assert [f.t_ns for f in capture(times_ms=times)] == [round(t * 1e6) for t in [*even[:10], 390.0, *even[11:]]]


def test_a_damaged_video_never_raises(tmp_path):
    path = write_video(tmp_path / "walk.mp4")
    data = path.read_bytes()
    middle, length = len(data) // 2, len(data) // 10
    for patch in (bytes(length), np.random.default_rng(0).bytes(length)):
        path.write_bytes(data[:middle] + patch + data[middle + length :])
        frames = list(open_path(path))
        assert 10 < len(frames) <= 40
        assert [frame.index for frame in frames] == list(range(len(frames)))
        assert all(a.t_ns < b.t_ns for a, b in pairwise(frames))
        assert {frame.problem for frame in frames} <= {"", "unreadable"}


# size


def test_stretch_resamples_all_rows_and_crop_takes_the_middle_ones(tmp_path):
    folder = write_folder(tmp_path / "room", 3, height=36)
    stretched, cropped = (open_path(folder, camera_fit=fit) for fit in ("stretch", "crop"))
    assert stretched.camera == cropped.camera == Equirectangular(64, 32)
    for frame in cropped:
        np.testing.assert_array_equal(frame.image, texture(frame.index, height=36)[2:34])
    for frame in stretched:
        assert frame.image is not None
        assert np.abs(frame.image.astype(int) - texture(frame.index)).max() <= 4


@pytest.mark.parametrize(("width", "height", "fit"), [(64, 32, "none"), (64, 36, "stretch"), (64, 36, "crop")])
@pytest.mark.parametrize("resize", [(32, 16), (128, 64), (48, 24)])
def test_resize_gives_images_of_that_size(tmp_path, width, height, fit, resize):
    folder = write_folder(tmp_path / "room", 3, width=width, height=height)
    images = open_path(folder, camera_fit=fit, resize=resize)
    assert images.camera == Equirectangular(*resize)
    for frame in images:
        assert frame.image is not None
        assert frame.image.shape == (resize[1], resize[0], 3)
        if fit != "crop":
            assert np.abs(frame.image.astype(int) - texture(frame.index, *resize)).mean() < 4


def test_shrinking_keeps_the_mean_brightness(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (3, 64, 128, 3), dtype=np.uint8)
    for index, image in enumerate(noise):
        write_image(tmp_path / f"{index}.png", image)
    for frame in open_path(tmp_path, resize=(32, 16)):
        assert frame.image is not None
        blocks = noise[frame.index].reshape(16, 4, 32, 4, 3).mean((1, 3))
        assert np.abs(frame.image - blocks).max() <= 0.51


@pytest.mark.parametrize(
    ("width", "height", "fit", "message"),
    [
        (640, 322, "none", r"^input: expected a width of twice the height, got 640 x 322 \(0\.6 % off\); camera\.fit="
                           r"stretch or camera\.fit=crop accepts it\.$"),
        (640, 300, "none", r"got 640 x 300 \(6\.7 % off\); camera\.fit=stretch accepts it\.$"),
        (640, 300, "crop", r"^camera\.fit: expected, for crop, .* got 640 x 300 \(6\.7 % off\); camera\.fit=stretch"),
        (641, 322, "crop", r"^camera\.fit: expected, for crop, an even width"),
    ],
)  # fmt: skip
def test_a_size_that_is_not_two_to_one_is_refused_with_how_far_it_is_off(width, height, fit, message):
    with pytest.raises(InputError, match=message):
        plan_fit(width, height, fit, None)


def test_an_odd_width_can_be_stretched(tmp_path):
    images = open_path(write_folder(tmp_path / "room", 2, width=65, height=32), camera_fit="stretch")
    assert images.camera == Equirectangular(64, 32)
    assert [frame.image.shape for frame in images if frame.image is not None] == [(32, 64, 3)] * 2


def test_a_lens_stands_in_for_the_panorama_and_its_bad_frames_are_told_alike(tmp_path):
    folder = write_folder(tmp_path / "room", 5, width=64, height=48)
    write_image(folder / "frame1.png", texture(1))
    write_image(folder / "frame2.png", np.zeros((48, 64, 3), np.uint8))
    view = undistort(Lens(64, 48, 60.0, 60.0, 32.0, 24.0, "radtan", (-0.1, 0.0, 0.0, 0.0)))
    selection = Selection(stop=4)
    source, size = open_source(str(folder), selection, None)
    assert size == view.source_size == (64, 48)
    images = Images(source, view, selection)
    assert (images.camera, images.mask, images.length, images.truth) == (view.camera, view.mask, 4, None)
    frames = list(images)
    assert [frame.problem for frame in frames] == ["", "size", "black", ""]
    np.testing.assert_array_equal(frames[3].image, view(texture(3, 64, 48)))


# bad frames


def test_bad_frames_are_marked_and_the_sequence_goes_on(tmp_path):
    folder = write_folder(tmp_path / "room", 9)
    write_image(folder / "frame1.png", np.zeros((32, 64, 3), np.uint8))
    write_image(folder / "frame2.png", np.full((32, 64, 3), 255, np.uint8))
    write_image(folder / "frame3.png", texture(3, 32, 16))
    (folder / "frame4.png").write_bytes(b"not an image")
    (folder / "frame5.png").write_bytes((folder / "frame0.png").read_bytes()[:500])
    (folder / "frame6.png").write_bytes(b"")
    image = (texture(7) / 255).astype(np.float32)
    image[5, 5, 1] = np.nan
    (folder / "frame7.png").unlink()
    np.save(folder / "frame7.npy", image)
    frames = list(open_path(folder))
    assert [frame.problem for frame in frames] == [
        "", "black", "white", "size", "unreadable", "unreadable", "unreadable", "nan", "",
    ]  # fmt: skip
    assert [frame.index for frame in frames] == list(range(9))
    for frame in frames:
        assert (frame.image is None) == (frame.problem in ("size", "unreadable", "nan"))
        assert frame.image is None or frame.image.shape == (32, 64, 3)


def test_a_dark_frame_with_one_light_and_a_bright_one_with_texture_are_good(tmp_path):
    night, snow = np.zeros((32, 64, 3), np.uint8), np.full((32, 64, 3), 255, np.uint8)
    night[10, 20] = 200
    snow[::2] = 240
    write_image(tmp_path / "0.png", night)
    write_image(tmp_path / "1.png", snow)
    assert [frame.problem for frame in open_path(tmp_path)] == ["", ""]


@pytest.mark.parametrize("bad", [b"", b"not an image"])
def test_a_bad_start_does_not_prevent_opening(tmp_path, bad):
    folder = write_folder(tmp_path / "room")
    for index in range(5):
        (folder / f"frame{index}.png").write_bytes(bad)
    images = open_path(folder)
    assert images.camera == Equirectangular(64, 32)
    assert [frame.problem for frame in images] == ["unreadable"] * 5 + [""] * 7
    assert open_path(folder, start=4).length == 8


# input that is refused


def test_what_is_missing_or_no_input_is_refused(tmp_path):
    cases = {
        "absent.mp4": "absent.mp4, which does not exist",
        "absent/*.png": r"expected image files \(png, .*\), got no match for",
        "empty": r"expected image files \(png, .*\), got the folder .* without any",
        "text": r"expected image files \(png, .*\), got the folder .* without any",
        "text/notes.txt": r"expected a video or a folder of images, got .*notes\.txt, which cannot be read as one",
        "text/empty.mp4": r"expected a video or a folder of images, got .*empty\.mp4, which cannot be read as one",
        "one.png": r"expected a video or at least two frames \(a folder or a glob pattern\), got the image .*one\.png",
    }
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "notes.txt").write_text("not a video")
    (tmp_path / "text" / "empty.mp4").write_bytes(b"")
    write_image(tmp_path / "one.png", texture(0))
    for name, message in cases.items():
        with pytest.raises(InputError, match=f"^input: .*{message}") as refused:
            open_path(tmp_path / name)
        assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"^input: expected a video, .* got an empty name\.$"):
        open_images("")


def test_a_video_cut_before_its_index_is_refused(tmp_path):
    path = write_video(tmp_path / "walk.mp4")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(
        InputError, match=r"^input: expected a video .* got .*walk\.mp4, which cannot be read as one\.$"
    ):
        open_path(path)


def test_images_that_cannot_be_read_at_all_are_refused(tmp_path):
    for index in range(3):
        (tmp_path / f"{index}.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match=r"^input: expected readable images, got none among the first of "):
        open_path(tmp_path)


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_fewer_than_two_frames_are_refused(tmp_path, kind):
    one = write_folder(tmp_path / "one", 1) if kind == "folder" else write_video(tmp_path / "one.avi", 1)
    with pytest.raises(InputError, match=r"^input: expected at least two frames, got 1\.$"):
        open_path(one)
    path = write_folder(tmp_path / "room") if kind == "folder" else write_video(tmp_path / "room.avi", 12)
    for options in ({"start": 11}, {"stop": 1}, {"every": 12}, {"start": 4, "stop": 8, "every": 4}):
        with pytest.raises(InputError, match=r"expected at least two frames after start, stop and every, got 1\.$"):
            open_path(path, **options)
    with pytest.raises(InputError, match=r"^start: expected less than the 12 frames of the input, got 12\.$"):
        open_path(path, start=12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": -1}, "start: expected at least 0, got -1"),
        ({"start": 5, "stop": 5}, r"stop: expected more than start \(5\), got 5"),
        ({"stop": -1}, r"stop: expected more than start \(0\), got -1"),
        ({"every": 0}, "every: expected at least 1, got 0"),
        ({"fps": 1e-300}, r"fps: expected a frame rate from 0\.001 to 1e\+06, got 1e-300"),
        ({"fps": 1e10}, r"fps: expected a frame rate from 0\.001 to 1e\+06, got 10000000000\.0"),
        ({"fps": 0.0}, r"fps: expected a frame rate above 0, got 0\.0"),
        ({"fps": float("nan")}, "fps: expected a frame rate above 0, got nan"),
        ({"resize": (512, 255)}, "resize: expected a width of twice the height, got 512 x 255"),
        ({"resize": (0, 0)}, "resize: expected a width of twice the height, got 0 x 0"),
        ({"camera_fit": "pad"}, r"camera\.fit: expected one of none, stretch, crop, got 'pad'"),
    ],
)
def test_an_argument_out_of_range_is_named(tmp_path, options, message):
    with pytest.raises(InputError, match=rf"^{message}\.$"):
        open_path(write_folder(tmp_path / "room", 3), **options)


def test_a_video_that_is_not_two_to_one_is_refused(tmp_path):
    path = write_video(tmp_path / "walk.avi", 3, height=36)
    with pytest.raises(InputError, match=r"^input: .* got 64 x 36 \(11\.1 % off\)"):
        open_path(path)
    assert open_path(path, camera_fit="crop").camera == Equirectangular(64, 32)


# recorded data


def test_every_frame_of_the_recorded_walk_is_read():
    path = SHARED / "data" / "theta_walk" / "richoh1_0_3.mp4"
    if not path.exists():
        pytest.skip("the shared test data is absent")
    frames = [(frame.index, frame.t_ns, frame.problem) for frame in open_path(path, camera_fit="stretch")]
    assert frames == [(index, round(index * 1e9 / 30), "") for index in range(1202)]
