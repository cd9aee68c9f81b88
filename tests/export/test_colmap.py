"""The sparse model: pycolmap loads both forms, and its points are where the world has them."""

import shutil
import struct

import cv2
import numpy as np
import pytest
import torch
from exact_run import HOSTS, exact_run, sequence_of

from torchvo360.cameras import Pinhole
from torchvo360.checks import InputError
from torchvo360.export.colmap import PosedImage, write_colmap
from torchvo360.export.cubemap import Views
from torchvo360.export.dataset import Material, export_colmap
from torchvo360.export.recorded import Recorded

CAMERA = Pinhole(100, 80, 60.0, 55.0, 50.5, 39.0)


def exported(folder, sequence, recorded: Recorded, frames, *, mask=None, **settings) -> list[str]:
    views = Views.of(sequence.camera, **settings)
    folder.mkdir()
    return export_colmap(folder, Material(sequence, mask, recorded, frames, "png"), views, lambda _: None)


def reconstruction(folder, suffix: str):
    """Load the model from the files of one form alone."""
    pycolmap = pytest.importorskip("pycolmap")
    alone = folder / f"only_{suffix}"
    alone.mkdir()
    for file in (folder / "sparse" / "0").glob(f"*.{suffix}"):
        shutil.copy(file, alone)
    return pycolmap.Reconstruction(str(alone))


def index_of(name: str) -> int:
    return int(name.removesuffix(".png").split("_")[1])


@pytest.fixture(scope="module", params=["equirectangular", "pinhole"])
def world(request, tmp_path_factory):
    sequence = sequence_of(request.param)
    recorded = exact_run(sequence)
    folder = tmp_path_factory.mktemp("colmap") / request.param
    notes = exported(folder, sequence, recorded, list(HOSTS))
    return folder, sequence, recorded, notes


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_pycolmap_loads_it_and_reprojects_its_points_within_a_pixel(world, suffix, tmp_path):
    folder, sequence, recorded, _ = world
    shutil.copytree(folder / "sparse", tmp_path / "sparse")
    model = reconstruction(tmp_path, suffix)
    assert len(model.points3D) == len(recorded.xyz)
    assert len(model.images) == len(HOSTS) * (6 if sequence.camera.wraps else 1)
    off, own_off = [], []
    for number, point in model.points3D.items():
        host = f"frame_{int(recorded.host[number - 1]):06d}"
        assert point.track.length() != 1
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.points2D[element.point2D_idx]
            assert seen.point3D_id == number
            off.append(np.linalg.norm(image.project_point(point.xyz) - seen.xy))
            own_off += [off[-1]] if image.name.startswith(host) else []
    assert np.median(off) < 1
    assert len(own_off) > 0.7 * len(recorded.xyz)
    assert max(own_off) < 1e-3  # in its own keyframe, a point's observation is its pixel there
    stored = np.array([point.error for point in model.points3D.values()])
    model.update_point_3d_errors()
    np.testing.assert_allclose(stored, [point.error for point in model.points3D.values()], atol=1e-4)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_points_colours_and_poses_are_the_runs(world, suffix, tmp_path):
    folder, sequence, recorded, _ = world
    shutil.copytree(folder / "sparse", tmp_path / "sparse")
    model = reconstruction(tmp_path, suffix)
    order = range(1, len(recorded.xyz) + 1)
    xyz = np.stack([model.points3D[number].xyz for number in order])
    np.testing.assert_allclose(xyz, recorded.xyz.numpy(), rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(np.stack([model.points3D[n].color for n in order]), recorded.rgb.numpy())
    for image in model.images.values():
        centre = sequence.pose(index_of(image.name))[:3, 3].numpy()
        np.testing.assert_allclose(image.projection_center(), centre, atol=1e-9)


def test_colmaps_bundle_adjustment_takes_it_up_and_keeps_the_cameras(world, tmp_path):
    folder, sequence, _, _ = world
    shutil.copytree(folder / "sparse", tmp_path / "sparse")
    model = reconstruction(tmp_path, "bin")
    import pycolmap

    before = model.compute_mean_reprojection_error()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < before < 1
    path = float((sequence.pose(HOSTS[-1]) - sequence.pose(HOSTS[0]))[:3, 3].norm())
    off = [
        np.linalg.norm(image.projection_center() - sequence.pose(index_of(image.name))[:3, 3].numpy())
        for image in model.images.values()
    ]
    assert np.median(off) < 0.1 * path  # faces of 82 pixels are no more sure of their places


def test_points_show_their_colours_at_their_pixels_in_every_image_that_claims_them(world, tmp_path):
    """Geometry, images and files together: the exported picture at an observation has the point's colour."""
    folder, _, recorded, _ = world
    shutil.copytree(folder / "sparse", tmp_path / "sparse")
    model = reconstruction(tmp_path, "bin")
    differences = []
    for image in model.images.values():
        picture = cv2.imread(str(folder / "images" / image.name))[..., ::-1].astype(float)
        assert picture.shape[:2] == (image.camera.height, image.camera.width)
        seen = [point for point in image.points2D if point.has_point3D()]
        for point in seen:
            column, row = (point.xy - 0.5).round().astype(int).clip(0, np.array(picture.shape[1::-1]) - 1)
            differences.append(np.abs(picture[row, column] - recorded.rgb[point.point3D_id - 1].numpy()).mean())
    assert len(differences) > 2 * len(recorded.xyz)
    assert np.median(differences) < 15


def test_the_files_of_trainers_are_there(world):
    folder, sequence, _, notes = world
    assert notes == []
    assert {path.name for path in (folder / "sparse" / "0").iterdir()} == {
        f"{name}.{suffix}" for name in ("cameras", "images", "points3D") for suffix in ("bin", "txt")
    }
    names = {path.name for path in (folder / "images").iterdir()}
    faces = ("_front", "_right", "_back", "_left", "_up", "_down") if sequence.camera.wraps else ("",)
    assert names == {f"frame_{index:06d}{face}.png" for index in HOSTS for face in faces}
    assert (folder / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1].startswith("1 PINHOLE ")
    if not sequence.camera.wraps:
        image = cv2.imread(str(folder / "images" / "frame_000010.png"))[..., ::-1]
        np.testing.assert_array_equal(image, sequence.frame(10).image)


def test_frames_other_than_keyframes_see_the_points_too(tmp_path):
    sequence = sequence_of()
    recorded = exact_run(sequence)
    exported(tmp_path / "data", sequence, recorded, [4, 8], faces=4, fov_deg=100.0)
    model = reconstruction(tmp_path / "data", "bin")
    assert len(model.images) == 8
    lengths = np.array([point.track.length() for point in model.points3D.values()])
    assert len(lengths) == len(recorded.xyz)
    assert np.mean(lengths >= 2) > 0.5
    assert lengths.max() > 2  # where faces overlap, both see a point


def test_masks_come_along_and_nothing_is_seen_in_them(tmp_path):
    sequence = sequence_of()
    mask = torch.ones(128, 256, dtype=torch.bool)
    mask[70:] = False
    recorded = exact_run(sequence)
    notes = exported(tmp_path / "data", sequence, recorded, [5, 8], mask=mask)
    assert notes == ["left out, as the mask leaves nothing of them: faces down."]
    names = {path.name for path in (tmp_path / "data" / "images").iterdir()}
    assert names == {
        f"frame_{index:06d}_{face}.png" for index in (5, 8) for face in ("front", "right", "back", "left", "up")
    }
    assert {path.name for path in (tmp_path / "data" / "masks").iterdir()} == {f"{name}.png" for name in names}
    for image in reconstruction(tmp_path / "data", "bin").images.values():
        white = cv2.imread(str(tmp_path / "data" / "masks" / f"{image.name}.png"), cv2.IMREAD_GRAYSCALE)
        assert set(np.unique(white)) <= {0, 255}
        uv = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        row = (uv[:, 1].astype(int) - 3).clip(0)  # a patch may have moved by 1.5 pixels of the panorama
        assert len(uv) > 10 or "up" in image.name
        assert (white[row, uv[:, 0].astype(int).clip(0, white.shape[1] - 1)] == 255).all()


def test_intrinsics_that_the_run_found_are_those_of_the_model(tmp_path):
    sequence = sequence_of("pinhole")
    recorded = exact_run(sequence, intrinsics=(101.0, 102.0, 99.0, 77.0))
    camera = recorded.camera_of(sequence.camera)
    folder = tmp_path / "data"
    folder.mkdir()
    export_colmap(folder, Material(sequence, None, recorded, [0], "png"), Views.of(camera), lambda _: None)
    assert (folder / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1] == "1 PINHOLE 200 150 101 102 99 77"


def test_images_without_points_and_points_without_images_are_written(tmp_path):
    T = torch.eye(4, dtype=torch.float64)
    uv = torch.tensor([[10.0, 20.0], [30.0, 40.0]], dtype=torch.float64)
    images = [
        PosedImage("none.png", T, uv[:0], torch.zeros(0, dtype=torch.int64)),
        PosedImage("two.png", T, uv, torch.tensor([2, 0])),
    ]
    xyz = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 2.0], [0.0, 1.0, 3.0]])
    write_colmap(tmp_path, CAMERA, images, xyz, torch.full((3, 3), 7, dtype=torch.uint8))
    (tmp_path / "sparse").mkdir()
    for path in list(tmp_path.glob("*.*")):
        (tmp_path / "sparse" / "0").mkdir(exist_ok=True)
        path.rename(tmp_path / "sparse" / "0" / path.name)
    for suffix in ("bin", "txt"):
        model = reconstruction(tmp_path, suffix)
        lengths = {number: point.track.length() for number, point in model.points3D.items()}
        assert lengths == {1: 1, 2: 0, 3: 1}
        assert {image.name: len(image.points2D) for image in model.images.values()} == {"none.png": 0, "two.png": 2}


def test_the_binary_points_are_as_the_format_says(tmp_path):
    """Read by the layout alone: id, x, y, z, colour, error, length of the track, then image and index of each entry."""
    T = torch.eye(4, dtype=torch.float64)
    image = PosedImage("a.png", T, torch.tensor([[53.5, 39.0]], dtype=torch.float64), torch.tensor([1]))
    xyz = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 2.0]])
    write_colmap(tmp_path, CAMERA, [image], xyz, torch.tensor([[1, 2, 3], [4, 5, 6]], dtype=torch.uint8))
    data = (tmp_path / "points3D.bin").read_bytes()
    assert struct.unpack_from("<Q", data) == (2,)
    assert struct.unpack_from("<QdddBBBdQ", data, 8) == (1, 1.0, 2.0, 3.0, 1, 2, 3, 0.0, 0)
    assert struct.unpack_from("<QdddBBBdQii", data, 8 + 51) == (2, 0.0, 0.0, 2.0, 4, 5, 6, 3.0, 1, 1, 0)
    assert len(data) == 8 + 51 + 51 + 8


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([], "images: expected at least one, got none"),
        ([PosedImage("a", torch.zeros(4, 4).double(), torch.zeros(0, 2), torch.zeros(0).long())], "rigid motions"),
        (
            [PosedImage("a", torch.eye(4).double(), torch.zeros(1, 2).double(), torch.tensor([5]))],
            "point: expected 0 to 2, got others in a",
        ),
    ],
)
def test_a_model_that_makes_no_sense_is_refused(tmp_path, images, message):
    with pytest.raises(InputError, match=message):
        write_colmap(tmp_path, CAMERA, images, torch.ones(3, 3), torch.zeros(3, 3, dtype=torch.uint8))
    assert not list(tmp_path.iterdir())
