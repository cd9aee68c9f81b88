"""transforms.json: points go through the written file, by nerfstudio's own rays, to the pixels where they are here."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from exact_run import FRAMES, HOSTS, exact_run, sequence_of

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.export import read_ply
from torchvo360.export.dataset import Material, export_nerfstudio
from torchvo360.export.nerfstudio import Shot, upright, write_nerfstudio
from torchvo360.lie import se3_inverse


def rays_as_documented(meta: dict, c2w: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return directions in the saved world of pixels, as nerfstudio's class Cameras makes them.

    Pixel (0, 0) has its ray through its centre, (0.5, 0.5); for a panorama fx = fy = height = width / 2.
    """
    x = (uv[:, 0] - meta["cx"]) / meta["fl_x"]
    y = -(uv[:, 1] - meta["cy"]) / meta["fl_y"]  # from OpenCV's axes to OpenGL's
    if meta["camera_model"] == "EQUIRECTANGULAR":
        theta, phi = -math.pi * x, math.pi * (0.5 - y)
        local = [-np.sin(theta) * np.sin(phi), np.cos(phi), -np.cos(theta) * np.sin(phi)]
    else:
        local = [x, y, -np.ones_like(x)]
    directions = np.stack(local, -1) @ c2w[:3, :3].T
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@pytest.fixture(params=["equirectangular", "pinhole"])
def exported(request, tmp_path):
    sequence = sequence_of(request.param)
    recorded = exact_run(sequence)
    frames, _ = recorded.chosen("keyframes")
    notes = export_nerfstudio(tmp_path, Material(sequence, None, recorded, frames, "png"), lambda _: None)
    assert notes == []
    return tmp_path, sequence, recorded


def test_points_are_seen_at_the_pixels_where_the_run_has_them(exported):
    folder, sequence, recorded = exported
    meta = json.loads((folder / "transforms.json").read_text())
    saved, rgb, host = read_ply(folder / meta["ply_file_path"])
    assert torch.equal(rgb, recorded.rgb)
    for index, frame in zip(HOSTS, meta["frames"], strict=True):
        c2w = np.array(frame["transform_matrix"])
        p_cam = recorded.xyz.double() - sequence.pose(index)[:3, 3]
        uv, valid = sequence.camera.project(p_cam @ sequence.pose(index)[:3, :3])
        assert int(valid.sum()) > 200
        directions = rays_as_documented(meta, c2w, uv[valid].numpy())
        towards = saved[valid].double().numpy() - c2w[:3, 3]
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        off_px = np.linalg.norm(directions - towards, axis=-1) / sequence.camera.pixel_angle
        assert off_px.max() < 1e-2  # the points are float32
        own = (host[valid] == index).numpy()  # a point's pixel in its own keyframe is a centre
        centre = uv[valid].numpy()[own] - 0.5
        assert np.abs(centre - centre.round()).max() < 1e-2


def test_the_images_are_the_frames_and_the_keys_are_nerfstudios(exported):
    folder, sequence, _ = exported
    meta = json.loads((folder / "transforms.json").read_text())
    width, height = sequence.camera.width, sequence.camera.height
    assert (meta["w"], meta["h"]) == (width, height)
    if sequence.camera.wraps:
        assert meta["camera_model"] == "EQUIRECTANGULAR"
        assert (meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"]) == (width / 2, height, width / 2, height / 2)
    else:
        assert meta["camera_model"] == "OPENCV"
        assert (meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"]) == sequence.camera.intrinsics
    for index, frame in zip(HOSTS, meta["frames"], strict=True):
        image = cv2.imread(str(folder / frame["file_path"]))
        np.testing.assert_array_equal(image[..., ::-1], sequence.frame(index).image)
        assert "mask_path" not in frame


def test_the_saved_world_is_the_runs_by_the_applied_transform(exported):
    folder, sequence, recorded = exported
    meta = json.loads((folder / "transforms.json").read_text())
    T = torch.tensor([*meta["applied_transform"], [0, 0, 0, 1]], dtype=torch.float64)
    saved, _, _ = read_ply(folder / meta["ply_file_path"])
    torch.testing.assert_close(saved.double(), recorded.xyz.double() @ T[:3, :3].mT + T[:3, 3], atol=1e-5, rtol=1e-6)
    for index, frame in zip(HOSTS, meta["frames"], strict=True):
        T_world_cam = se3_inverse(T) @ torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        T_world_cam[:3, 1:3] *= -1
        torch.testing.assert_close(T_world_cam, sequence.pose(index), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    "gravity", [None, (0.0, 9.8, 0.0), (1.0, 9.0, -3.0), (0.0, 0.0, 9.8), (9.8, 0.0, 0.0), (0.0, -9.8, 0.0)]
)
def test_down_becomes_minus_z(gravity):
    T_saved_world = upright(gravity)
    g = torch.tensor(gravity or (0.0, 1.0, 0.0), dtype=torch.float64)
    down = T_saved_world[:3, :3] @ (g / g.norm())
    torch.testing.assert_close(down, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), atol=1e-12, rtol=0)
    assert float(torch.linalg.det(T_saved_world)) == pytest.approx(1.0)


def test_a_mask_is_named_by_every_frame_and_white_where_the_image_counts(tmp_path):
    sequence = sequence_of()
    recorded = exact_run(sequence)
    mask = torch.ones(128, 256, dtype=torch.bool)
    mask[100:] = False
    export_nerfstudio(tmp_path, Material(sequence, mask, recorded, [0, 5], "jpg"), lambda _: None)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/frame_000000.jpg", "images/frame_000005.jpg"]
    for frame in frames:
        image = cv2.imread(str(tmp_path / frame["mask_path"]), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(image, mask.numpy() * np.uint8(255))


def test_a_part_of_a_sphere_and_no_images_are_refused(tmp_path):
    nothing = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8), torch.zeros(0, dtype=torch.int32)
    shot = Shot("a.png", torch.eye(4, dtype=torch.float64))
    with pytest.raises(InputError, match="camera: expected a full panorama or a pinhole for nerfstudio"):
        write_nerfstudio(tmp_path, Equirectangular(64, 20, 20.0, -20.0, 32.0, 10.0), [shot], *nothing)
    with pytest.raises(InputError, match="shots: expected at least one image, got none"):
        write_nerfstudio(tmp_path, Equirectangular(64, 32), [], *nothing)
    with pytest.raises(InputError, match="gravity: expected a direction"):
        upright((0.0, 0.0, 0.0))
    assert not list(tmp_path.iterdir())


def test_reading_stops_at_the_last_frame_that_is_wanted(tmp_path):
    sequence = sequence_of()
    read = []
    export_nerfstudio(tmp_path, Material(sequence, None, exact_run(sequence), [0, 4], "jpg"), read.append)
    assert sum(read) == 5 < FRAMES
