"""Undistortion: what one of our cameras would have seen, at the same place to a fraction of a pixel."""

import math

import numpy as np
import pytest
import torch

from torchvo360.cameras import Camera, Equirectangular, Lens, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.undistort import undistort

EUROC = Lens.of_opencv(
    376, 240, (229.3, 228.6, 183.4, 124.0), "radtan", (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
)
PINCUSHION = Lens.of_opencv(320, 240, (258.0, 258.0, 159.0, 127.0), "radtan", (0.2624, -0.15, -0.0054, 0.0026, 0.1))
FISHEYE = Lens(400, 300, 180.0, 180.0, 203.0, 147.0, "equidistant", (-0.0134, 0.0023, -0.0021, 0.0004))  # 125 x 95 deg
NARROW = Lens(400, 300, 260.0, 262.0, 203.0, 147.0, "equidistant", (-0.0134, 0.0023, -0.0021, 0.0004))
ROUND = Lens(400, 400, 118.0, 118.0, 201.0, 198.0, "equidistant", (0.01, 0.0, 0.0, 0.0))  # 190 degrees
PLAIN = Lens(320, 240, 250.0, 240.0, 163.0, 118.0)
MIRRORED = Lens(320, 240, 240.0, -240.0, 160.0, 120.0, "radtan", (-0.1, 0.01, 0.0, 0.0))


def pattern(ray: torch.Tensor) -> torch.Tensor:
    """Return colours of directions, smooth enough for bilinear interpolation."""
    ray = ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
    return 127 + 80 * torch.sin(7 * ray + 2 * ray.roll(1, -1))


def picture(lens: Lens) -> np.ndarray:
    """Return what a lens sees of the pattern; where it has no ray, black."""
    ray, valid = lens.ray(lens.pinhole.pixel_grid(dtype=torch.float64))
    return torch.where(valid[..., None], pattern(ray), 0).round().to(torch.uint8).numpy()


def error(camera: Camera, image: np.ndarray, mask: torch.Tensor | None) -> float:
    """Return the largest difference from what the camera would see of the pattern, of 255, inside the mask."""
    wrong = (torch.from_numpy(image).double() - pattern(camera.ray_grid(dtype=torch.float64))).abs().amax(-1)
    return float((wrong if mask is None else wrong[mask]).max())


@pytest.mark.parametrize("lens", [EUROC, PINCUSHION, NARROW, MIRRORED])
def test_a_pinhole_shows_what_it_would_have_seen_and_nothing_beyond_the_image(lens):
    made = undistort(lens)
    camera = made.camera
    assert isinstance(camera, Pinhole)
    assert (camera.fx, camera.fy) == (lens.fx, lens.fy), "the resolution of the middle"
    assert made.mask is None
    assert error(camera, made(picture(lens)), None) < 3


@pytest.mark.parametrize("lens", [EUROC, PINCUSHION, NARROW])
def test_a_pinhole_uses_the_image_up_to_an_edge_on_every_side(lens):
    camera = undistort(lens).camera
    wider = Pinhole(
        camera.width + 4, camera.height + 4, *camera.intrinsics[:2], *(c + 2 for c in camera.intrinsics[2:])
    )
    _, seen = lens.project(wider.ray_grid(dtype=torch.float64))
    assert not bool(seen[0].all() | seen[-1].all() | seen[:, 0].all() | seen[:, -1].all())


@pytest.mark.parametrize("size", [(200, 120), (160, 160), (96, 40), (640, 400)])
@pytest.mark.parametrize("lens", [EUROC, NARROW, PLAIN])
def test_a_size_cuts_a_pinhole_to_its_shape_and_keeps_square_what_is_square(lens, size):
    made = undistort(lens, size=size)
    camera = made.camera
    assert isinstance(camera, Pinhole)
    assert (camera.width, camera.height) == size
    assert camera.fx / camera.fy == pytest.approx(lens.fx / lens.fy)
    assert made.mask is None
    assert error(camera, made(picture(lens)), None) < 3


def test_an_undistorted_lens_changes_nothing():
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    for made in (undistort(PLAIN), undistort(PLAIN, size=(320, 240)), undistort(PLAIN, target="pinhole")):
        assert made.camera == PLAIN.pinhole
        assert made(image) is image
        assert made.depth(np.ones((240, 320), np.float32)).all()


def test_without_distortion_a_proportional_size_is_plain_averaging():
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    made = undistort(PLAIN, size=(160, 120))
    assert made.camera.intrinsics == pytest.approx(PLAIN.pinhole.resized(160, 120).intrinsics)
    blocks = image.reshape(120, 2, 160, 2, 3).mean((1, 3))
    assert np.abs(made(image) - blocks).max() <= 0.51


def test_a_wide_fisheye_becomes_the_part_of_a_panorama_that_it_sees():
    made = undistort(FISHEYE)
    camera = made.camera
    assert isinstance(camera, Equirectangular)
    assert not camera.wraps
    assert made.mask is not None
    assert error(camera, made(picture(FISHEYE)), made.mask) < 3
    assert camera.intrinsics[:2] == pytest.approx((180, -180), rel=0.01)
    # nothing is left out: every pixel of the lens is in it
    ray, _ = FISHEYE.ray(FISHEYE.pinhole.pixel_grid(dtype=torch.float64))
    uv, seen = camera.project(ray)
    assert float(seen.double().mean()) > 0.995
    assert float((uv - torch.tensor([camera.width / 2, camera.height / 2])).abs().max()) < camera.width / 2 + 2


def test_a_fisheye_that_sees_straight_up_becomes_a_whole_panorama_with_a_mask():
    made = undistort(ROUND)
    camera = made.camera
    assert isinstance(camera, Equirectangular)
    assert camera.wraps
    assert made.mask is not None
    assert error(camera, made(picture(ROUND)), made.mask) < 3
    share = float(camera.solid_angle(camera.pixel_grid(dtype=torch.float64))[made.mask].sum()) / (4 * math.pi)
    ray, valid = ROUND.ray(ROUND.pinhole.pixel_grid(dtype=torch.float64))
    most = float(torch.acos(ray[..., 2])[valid].max())
    assert 0.5 < share < (1 - math.cos(most)) / 2
    ahead, _ = camera.project(torch.tensor([0.0, 0.0, 1.0]))
    assert bool(made.mask[int(ahead[1]), int(ahead[0])])
    assert not bool(made.mask[camera.height // 2, 0]), "behind"


def test_beyond_what_the_lens_sees_there_is_no_black_edge():
    made = undistort(FISHEYE)
    bright = made(np.full((300, 400, 3), 200, np.uint8))
    assert int(bright.min()) == int(bright.max()) == 200


def test_a_principal_point_outside_the_image_is_no_harm():
    cut = Lens(200, 240, 229.3, 228.6, -40.0, 124.0, "radtan", EUROC.distortion)
    made = undistort(cut)
    assert made.mask is None
    assert error(made.camera, made(picture(cut)), None) < 3


def test_a_wide_lens_averages_before_it_shrinks():
    made = undistort(EUROC, size=(47, 30))
    noise = np.random.default_rng(0).integers(0, 256, (240, 376, 3), dtype=np.uint8)
    assert made(noise).std() < 0.35 * noise.std()


def test_depth_takes_the_nearest_value_and_never_mixes_two():
    depth = np.where(np.arange(376) < 180, 1.0, 5.0).astype(np.float32)[None].repeat(240, 0)
    depth[100:120] = 0
    for made in (undistort(EUROC), undistort(EUROC, size=(150, 100))):
        moved = made.depth(depth)
        assert moved.dtype == np.float32
        assert set(np.unique(moved)) == {0.0, 1.0, 5.0}
        assert moved.shape == (made.camera.height, made.camera.width)
    # where it comes from is where the image comes from
    image = np.repeat((depth * 40).astype(np.uint8)[..., None], 3, -1)
    made = undistort(EUROC)
    assert np.mean(np.abs(made(image)[..., 0] - made.depth(depth) * 40) > 20) < 0.01


def test_depth_is_zero_where_a_pinhole_sees_more_than_the_lens():
    folding = Lens(400, 300, 90.0, 90.0, 200.0, 150.0, "radtan", (-0.25, 0.0, 0.0, 0.0))  # its corners are folded
    made = undistort(folding)
    assert made.mask is not None
    moved = made.depth(np.ones((300, 400), np.float32))
    np.testing.assert_array_equal(moved > 0, made.mask.numpy())


@pytest.mark.parametrize(
    ("lens", "options", "message"),
    [
        (EUROC, {"target": "sphere"}, "target: expected one of auto, pinhole, panorama, got 'sphere'"),
        (EUROC, {"size": (0, 10)}, "size: expected a width and a height, got 0 x 10"),
        (ROUND, {"size": (300, 200)}, "size: expected a width of twice the height for a whole panorama, got 300 x 200"),
        (Lens(64, 48, 1.0, 1.0, 32.0, 24.0, "radtan", (0.0,) * 4), {}, "camera: expected .*, got 3 x 3"),
        (Lens(64, 48, 60.0, 60.0, 32.0, 24.0, "radtan", (-99.0, 0.0, 0.0, 0.0)), {}, "camera: .*, got 6 x 6"),
        (Lens(64, 48, 60.0, 60.0, 32.0, 24.0, "equidistant", (-99.0, 0.0, 0.0, 0.0)), {}, "camera: .* panorama, .*"),
        (Lens(64, 48, 9.0, 9.0, 900.0, 24.0), {"target": "panorama"}, "camera: expected a lens .*, got .*"),
    ],
)
def test_what_cannot_be_made_is_refused(lens, options, message):
    with pytest.raises(InputError, match=f"^{message}\\.$"):
        undistort(lens, **options)


def test_a_distortion_that_leaves_nothing_to_see_is_refused():
    with pytest.raises(InputError, match=r"^camera: expected a lens that sees some of what"):
        undistort(Lens(320, 200, 160.0, 160.0, 160.0, 100.0, "radtan", (1e30, 0.0, 0.0, 0.0)))


def test_images_of_another_size_and_depth_for_a_panorama_are_refused():
    made = undistort(EUROC)
    with pytest.raises(InputError, match=r"^image: expected the lens's 376 x 240 pixels, got 240 x 376\.$"):
        made(np.zeros((376, 240, 3), np.uint8))
    with pytest.raises(InputError, match=r"^depth: expected a pinhole camera for a sensor's z, got Equirectangular"):
        undistort(ROUND).depth(np.zeros((400, 400), np.float32))
