"""Camera pyramids: the files are what glTF and PLY ask for, and the pyramids stand where the cameras are."""

import json
import struct

import numpy as np
import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.export.frusta import ALONE, CORNERS, EDGES, SHARE, TRIANGLES, write_frusta
from torchvo360.lie import matrix_from_quaternion, se3_exp

COMPONENTS = {5121: "u1", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def poses(count: int) -> torch.Tensor:
    xi = torch.randn(count, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return se3_exp(xi)


def read_glb(data: bytes) -> tuple[dict, bytes]:
    """Read by the container's rules alone."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    chunks, at = {}, 12
    while at < len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        assert size % 4 == 0
        chunks[kind] = data[at + 8 : at + 8 + size]
        at += 8 + size
    assert at == len(data)
    assert list(chunks) == [b"JSON", b"BIN\0"]
    return json.loads(chunks[b"JSON"]), chunks[b"BIN\0"]


def values_of(content: dict, binary: bytes, number: int) -> np.ndarray:
    """Return an accessor's values, held to every bound on the way."""
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    kind, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
    assert view["byteOffset"] % 4 == 0  # vertex attributes and their strides are aligned to 4 bytes
    assert kind.itemsize * width % 4 == 0
    assert accessor["count"] * kind.itemsize * width <= view["byteLength"]
    assert view["byteOffset"] + view["byteLength"] <= content["buffers"][view["buffer"]]["byteLength"] <= len(binary)
    values = np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
    if "min" in accessor:
        np.testing.assert_array_equal(values.min(0), np.float32(accessor["min"]))
        np.testing.assert_array_equal(values.max(0), np.float32(accessor["max"]))
    return values


@pytest.mark.parametrize("count", [1, 2, 30])
def test_the_glb_is_valid_and_its_lines_are_the_pyramids_and_the_way(tmp_path, count):
    T_world_cam = poses(count)
    write_frusta(tmp_path / "cameras.glb", T_world_cam, size=0.5)
    content, binary = read_glb((tmp_path / "cameras.glb").read_bytes())
    assert content["asset"]["version"] == "2.0"
    (primitive,) = content["meshes"][content["nodes"][content["scenes"][content["scene"]]["nodes"][0]]["mesh"]][
        "primitives"
    ]
    assert primitive["mode"] == 1  # LINES
    xyz = values_of(content, binary, primitive["attributes"]["POSITION"])
    colour = values_of(content, binary, primitive["attributes"]["COLOR_0"])
    lines = values_of(content, binary, primitive["indices"]).reshape(-1, 2)
    assert "min" in content["accessors"][primitive["attributes"]["POSITION"]]  # the specification asks for them
    assert len(xyz) == len(colour) == len(CORNERS) * count
    assert len(lines) == len(EDGES) * count + count - 1
    assert 0 <= lines.min() <= lines.max() < len(xyz)
    np.testing.assert_allclose(xyz[:: len(CORNERS)], T_world_cam[:, :3, 3].numpy(), atol=1e-6)
    turn = matrix_from_quaternion(torch.tensor(content["nodes"][0]["rotation"], dtype=torch.float64))
    assert torch.equal(turn, torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)))  # y up


def read_ply_mesh(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    head, _, body = data.partition(b"end_header\n")
    counts = {
        line.split()[1]: int(line.split()[2]) for line in head.decode().splitlines() if line.startswith("element")
    }
    vertex = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    face = np.dtype([("count", "u1"), ("index", "<i4", 3)])
    assert len(body) == counts["vertex"] * vertex.itemsize + counts["face"] * face.itemsize
    vertices = np.frombuffer(body, vertex, counts["vertex"])
    faces = np.frombuffer(body, face, counts["face"], counts["vertex"] * vertex.itemsize)
    assert (faces["count"] == 3).all()
    return vertices["xyz"], vertices["rgb"], faces["index"]


def test_the_ply_holds_triangles_ahead_of_each_camera(tmp_path):
    T_world_cam = poses(4)
    write_frusta(tmp_path / "cameras.ply", T_world_cam, size=0.5)
    xyz, _, faces = read_ply_mesh((tmp_path / "cameras.ply").read_bytes())
    assert len(faces) == len(TRIANGLES) * 4
    assert 0 <= faces.min() <= faces.max() < len(xyz)
    corners = torch.from_numpy(xyz.copy()).double().view(4, len(CORNERS), 3)
    p_cam = (corners - T_world_cam[:, None, :3, 3]) @ T_world_cam[:, :3, :3]
    torch.testing.assert_close(p_cam, 0.5 * torch.tensor(CORNERS).double().expand(4, -1, -1), atol=1e-6, rtol=0)


def test_colours_tell_the_time_and_the_usual_size_follows_the_way(tmp_path):
    T_world_cam = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    T_world_cam[:, 0, 3] = torch.arange(5) * 10.0
    write_frusta(tmp_path / "cameras.ply", T_world_cam)
    xyz, rgb, _ = read_ply_mesh((tmp_path / "cameras.ply").read_bytes())
    assert xyz[:, 2].max() == pytest.approx(SHARE * 40.0)
    assert len(np.unique(rgb.reshape(5, -1, 3)[:, 0], axis=0)) == 5
    assert (rgb.reshape(5, -1, 3) == rgb.reshape(5, -1, 3)[:, :1]).all()
    write_frusta(tmp_path / "still.ply", T_world_cam[:1])
    assert read_ply_mesh((tmp_path / "still.ply").read_bytes())[0][:, 2].max() == pytest.approx(ALONE)


@pytest.mark.parametrize(
    ("name", "count", "size", "message"),
    [
        ("cameras.obj", 1, None, "out: expected one of .glb, .ply, got '.obj'"),
        ("cameras.glb", 0, None, "expected at least one pose, got none"),
        ("cameras.glb", 1, 0.0, "size: expected a finite number above 0, got 0.0"),
    ],
)
def test_what_cannot_be_drawn_is_refused_and_nothing_is_written(tmp_path, name, count, size, message):
    with pytest.raises(InputError, match=message):
        write_frusta(tmp_path / name, poses(count), size=size)
    assert not list(tmp_path.iterdir())
