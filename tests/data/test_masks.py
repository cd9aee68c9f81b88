import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.masks import parse_mask

CAMERA = Equirectangular(64, 32)


def longitude_latitude_deg(camera: Equirectangular) -> tuple[torch.Tensor, torch.Tensor]:
    """By the layout of the image alone: 360 degrees across, 180 down."""
    lon = (torch.arange(camera.width) + 0.5) / camera.width * 360 - 180
    lat = 90 - (torch.arange(camera.height) + 0.5) / camera.height * 180
    return lon.expand(camera.height, -1), lat[:, None].expand(-1, camera.width)


def saved(path, grey: np.ndarray) -> str:
    assert cv2.imwrite(str(path), grey)
    return str(path)


def test_latitude_is_positive_upwards():
    _, lat = longitude_latitude_deg(CAMERA)
    torch.testing.assert_close(parse_mask("below:-18", CAMERA), lat >= -18)
    torch.testing.assert_close(parse_mask("above:70", CAMERA), lat <= 70)
    mask = parse_mask("below:-18", CAMERA)
    assert bool(mask[0].all())
    assert not bool(mask[-1].any())


def test_a_list_leaves_what_passes_every_item():
    both = parse_mask(["below:-18", "above:70", "box:10:-10:50:20"], CAMERA)
    one = [parse_mask(item, CAMERA) for item in ("below:-18", "above:70", "box:10:-10:50:20")]
    torch.testing.assert_close(both, one[0] & one[1] & one[2])
    assert bool(parse_mask([], CAMERA).all())


@settings(max_examples=50, deadline=None)
@given(lon0=st.integers(-180, 180), lon1=st.integers(-180, 180), lat0=st.integers(-90, 0), lat1=st.integers(1, 90))
def test_a_box_goes_east_and_may_cross_the_seam(lon0, lon1, lat0, lat1):
    width = (lon1 - lon0) % 360 if lon0 > lon1 else lon1 - lon0
    if width > 350 and lat1 - lat0 > 170:
        return  # next to nothing would be left
    lon, lat = longitude_latitude_deg(CAMERA)
    inside = ((lon - lon0) % 360 <= width) & (lat >= lat0) & (lat <= lat1)
    torch.testing.assert_close(parse_mask(f"box:{lon0}:{lat0}:{lon1}:{lat1}", CAMERA), ~inside)


def test_a_box_across_the_seam_takes_both_edges_of_the_image_and_not_its_middle():
    mask = parse_mask("box:170:-20:-170:20", CAMERA)
    assert not bool(mask[16, 0])
    assert not bool(mask[16, -1])
    assert bool(mask[:, 32].all())
    assert int((~mask[16]).sum()) == 4  # 20 of 360 degrees, of 64 columns


def test_rolling_the_image_by_a_turn_moves_a_box_with_it():
    torch.testing.assert_close(
        parse_mask("box:-45:-30:0:30", CAMERA).roll(32, 1), parse_mask("box:135:-30:180:30", CAMERA)
    )


def test_white_in_an_image_means_use(tmp_path):
    grey = np.zeros((32, 64), np.uint8)
    grey[:, :20] = 255
    grey[:, 20:30] = 128
    grey[:, 30:40] = 127
    mask = parse_mask(saved(tmp_path / "mask.png", grey), CAMERA)
    assert mask.dtype == torch.bool
    assert bool(mask[:, :30].all())
    assert not bool(mask[:, 30:].any())
    joined = parse_mask([str(tmp_path / "mask.png"), "below:0"], CAMERA)
    torch.testing.assert_close(joined, mask & parse_mask("below:0", CAMERA))


def test_a_pinhole_camera_takes_images_only(tmp_path):
    camera = Pinhole(64, 32, 40.0, 40.0, 32.0, 16.0)
    white = np.full((32, 64), 255, np.uint8)
    assert bool(parse_mask(saved(tmp_path / "mask.png", white), camera).all())
    with pytest.raises(
        InputError, match=r"^mask: expected an image file for a Pinhole camera, got the sector 'below:0'"
    ):
        parse_mask("below:0", camera)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("below", "expected an image file or below:LAT"),
        ("below:", "expected an image file or below:LAT"),
        ("below:-18:3", "expected an image file or below:LAT"),
        ("below:south", "expected an image file or below:LAT"),
        ("box:1:2:3", "expected an image file or below:LAT"),
        ("left:20", "'left:20', which does not exist"),
        ("no/such/mask.png", "'no/such/mask.png', which does not exist"),
        ("", "'', which does not exist"),
        ("above:91", "expected an angle between -90 and 90 degrees, got 91"),
        ("below:nan", "expected an angle between -90 and 90 degrees, got nan"),
        ("box:-181:0:0:10", "expected an angle between -180 and 180 degrees, got -181"),
        ("box:0:-91:10:10", "expected an angle between -90 and 90 degrees, got -91"),
        ("box:0:20:10:20", "expected LAT0 below LAT1"),
        ("below:89", r"expected at least 1% of the image to be left, got 0\.00%"),
        (["below:10", "above:5"], r"expected at least 1% of the image to be left, got 0\.00%"),
    ],
)
def test_what_is_not_understood_or_leaves_nothing_is_refused(item, message):
    with pytest.raises(InputError, match=f"^mask: .*{message}"):
        parse_mask(item, CAMERA)


def test_bad_mask_images_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"^mask: expected the frames' size 64 x 32, got 32 x 16 in .*small\.png"):
        parse_mask(saved(tmp_path / "small.png", np.full((16, 32), 255, np.uint8)), CAMERA)
    with pytest.raises(InputError, match=r"^mask: expected at least 1% of the image to be left, got 0\.00%"):
        parse_mask(saved(tmp_path / "black.png", np.zeros((32, 64), np.uint8)), CAMERA)
    for name, content in (("text.png", b"not an image"), ("empty.png", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"^mask: expected an image file, got .*{name}, which cannot be read"):
            parse_mask(str(tmp_path / name), CAMERA)


def test_what_is_left_is_counted_in_solid_angle():
    # the two rows next to a pole are 6 % of the pixels and under 1 % of the sphere
    with pytest.raises(InputError, match=r"got 0\.\d\d%"):
        parse_mask("below:79", CAMERA)
    assert float(parse_mask("below:70", CAMERA).double().mean()) < 0.13
