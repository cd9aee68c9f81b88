"""A rig's frames cancel, and what is no rig is refused in one sentence."""

import pytest
import torch
from jaxtyping import Float64
from torch import Tensor

import torchvo360
from torchvo360.cameras import Equirectangular, Pinhole, Rig
from torchvo360.checks import InputError
from torchvo360.lie import se3_exp

SPHERE, PLANE = Equirectangular(64, 32), Pinhole(48, 36, 40.0, 42.0, 23.1, 17.4)


def poses(n: int) -> Float64[Tensor, "n 4 4"]:
    return se3_exp(torch.randn(n, 6, generator=torch.Generator().manual_seed(n), dtype=torch.float64))


def test_a_point_of_the_first_camera_is_the_same_point_in_another():
    T_body_cam = poses(3)
    rig = Rig((SPHERE, PLANE, SPHERE), T_body_cam)
    p_body = torch.tensor([0.3, -0.7, 1.9, 1.0], dtype=torch.float64)
    p_cam = torch.linalg.solve(T_body_cam, p_body.expand(3, 4)[..., None])[..., 0]
    for other in (1, 2):
        torch.testing.assert_close(rig.T_other_first(other) @ p_cam[0], p_cam[other], atol=1e-12, rtol=0)
        metres = float((T_body_cam[other, :3, 3] - T_body_cam[0, :3, 3]).norm())
        assert rig.baseline(other) == pytest.approx(metres)
    assert len(rig) == 3
    assert torchvo360.Rig is Rig


def test_the_body_s_own_frame_does_not_matter():
    T_body_cam = poses(2)
    first, second = Rig((SPHERE, PLANE), T_body_cam), Rig((SPHERE, PLANE), poses(1) @ T_body_cam)
    torch.testing.assert_close(first.T_other_first(1), second.T_other_first(1), atol=1e-12, rtol=0)


def test_a_rig_of_resampled_images_has_the_same_poses():
    rig = Rig((SPHERE, PLANE), poses(2))
    small = rig.resized([(32, 16), (24, 18)])
    assert small.cameras == (Equirectangular(32, 16), Pinhole(24, 18, 20.0, 21.0, 11.55, 8.7))
    assert torch.equal(small.T_body_cam, rig.T_body_cam)
    with pytest.raises(InputError, match=r"^sizes: expected one for each of the 2 cameras, got 1\.$"):
        rig.resized([(32, 16)])


def scaled(T: Tensor) -> Tensor:
    return torch.cat([T[:1], T[1:] * 1.1])


@pytest.mark.parametrize(
    ("cameras", "T_body_cam", "sentence"),
    [
        ((SPHERE,), poses(1), "cameras: expected at least two, got 1."),
        ((), poses(2), "cameras: expected at least two, got 0."),
        ((SPHERE, "left"), poses(2), f"cameras: expected a tuple of cameras, got ({SPHERE!r}, 'left')."),
        ((SPHERE, PLANE), poses(3), "T_body_cam: expected shape [2 4 4], got [3, 4, 4]."),
        ((SPHERE, PLANE), poses(2).float(), "T_body_cam: expected float64, got torch.float32."),
        ((SPHERE, PLANE), None, "T_body_cam: expected a tensor, got NoneType."),
        (
            (SPHERE, PLANE),
            scaled(poses(2)),
            "T_body_cam: expected rigid motions (orthonormal R, last row 0 0 0 1), got another matrix.",
        ),
        (
            (SPHERE, PLANE),
            poses(2) * torch.nan,
            "T_body_cam: expected rigid motions (orthonormal R, last row 0 0 0 1), got another matrix.",
        ),
    ],
)
def test_what_is_no_rig_is_refused_in_one_sentence(cameras, T_body_cam, sentence):
    with pytest.raises(InputError) as caught:
        Rig(cameras, T_body_cam)
    assert str(caught.value) == sentence


def test_a_baseline_needs_two_centres_and_a_camera_of_the_rig():
    T_body_cam = poses(1).repeat(2, 1, 1)
    T_body_cam[1, :3, :3] = T_body_cam[1, :3, :3].mT.clone()
    rig = Rig((PLANE, PLANE), T_body_cam)
    with pytest.raises(InputError, match=r"^T_body_cam: expected camera 1 apart from the first, got 0 m apart\.$"):
        rig.baseline(1)
    for other in (-1, 0, 2):
        for ask in (rig.T_other_first, rig.baseline):
            with pytest.raises(InputError, match=rf"^other: expected a camera from 1 to 1, got {other}\.$"):
                ask(other)
