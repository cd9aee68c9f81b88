"""Which image sees which point: what is hidden is not claimed, and where a patch lies is measured."""

import numpy as np
import pytest
import torch
from exact_run import FRAMES, HOSTS, exact_run, sequence_of

from torchvo360.cameras import Equirectangular
from torchvo360.export.recorded import Recorded
from torchvo360.export.tracks import LEAST_COSINE, REACH, Patches
from torchvo360.image.pyramid import blur
from torchvo360.image.sampling import sample

MIDDLE = (2 * REACH + 1) ** 2 // 2


def patches_of(sequence, recorded: Recorded) -> Patches:
    patches = Patches.empty(len(recorded.xyz))
    for host in HOSTS:
        which = recorded.host == host
        image = sequence.frame(host).image
        patches.fill(which, recorded.xyz[which], image, sequence.camera, sequence.pose(host))
    return patches


def truly_visible(sequence, recorded: Recorded, index: int) -> torch.Tensor:
    """Return which points the exact ranges about their pixels reach."""
    camera, T_world_cam = sequence.camera, sequence.pose(index)
    p_cam = (recorded.xyz.double() - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    uv, inside = camera.project(p_cam)
    reach = torch.nn.functional.max_pool2d(sequence.range(index)[None, None].nan_to_num(posinf=1e3), 3, 1, 1)[0, 0]
    column, row = uv[:, 0].long().clamp(0, camera.width - 1), uv[:, 1].long().clamp(0, camera.height - 1)
    return inside & (reach[row, column] > 0.95 * camera.scale(p_cam))


@pytest.mark.parametrize("settings", [{"world": "pillars"}, {"world": "room"}, {"world": "room", "camera": "pinhole"}])
def test_what_is_claimed_is_visible_and_most_that_is_visible_is_claimed(settings):
    sequence = sequence_of(noise=0.01, **settings)
    recorded = exact_run(sequence)
    patches = patches_of(sequence, recorded)
    claimed = right = visible = 0
    for index in range(2, FRAMES, 5):
        seen, _ = patches.seen(sequence.frame(index).image, sequence.camera, sequence.pose(index), None)
        truly = truly_visible(sequence, recorded, index)
        claimed, right, visible = (
            claimed + int(seen.sum()),
            right + int((seen & truly).sum()),
            visible + int(truly.sum()),
        )
    assert right > 0.98 * claimed
    assert right > 0.75 * visible


@pytest.mark.parametrize("away", [0.4, 3.0])
def test_points_in_front_of_a_wall_or_behind_it_are_not_claimed(away):
    """A wrong range keeps a point on its pixel in the host, and takes it elsewhere from another place."""
    sequence = sequence_of(world="room")
    recorded = exact_run(sequence)
    patches = patches_of(sequence, recorded)
    last = HOSTS[-1]
    image, pose, of_the_first = sequence.frame(last).image, sequence.pose(last), recorded.host == HOSTS[0]
    right, _ = patches.seen(image, sequence.camera, pose, None)
    centre = patches.host[:, None]
    moved = Patches((patches.xyz - centre) * away + centre, patches.value, patches.host)
    wrong, _ = moved.seen(image, sequence.camera, pose, None)
    uv_right, uv_wrong = (
        sequence.camera.pixel((p.xyz[:, MIDDLE].double() - pose[:3, 3]) @ pose[:3, :3]) for p in (patches, moved)
    )
    elsewhere = of_the_first & ((uv_wrong - uv_right).norm(dim=-1) > 2)
    assert int((right & of_the_first).sum()) > 0.85 * int(of_the_first.sum())
    assert int(elsewhere.sum()) > 200
    assert int((wrong & elsewhere).sum()) < 0.15 * int(elsewhere.sum())  # lines along which it moved


def test_masked_pixels_see_nothing_and_a_black_image_nothing_either():
    sequence = sequence_of()
    recorded = exact_run(sequence)
    patches = patches_of(sequence, recorded)
    image, pose = sequence.frame(5).image, sequence.pose(5)
    usable = torch.ones(128, 256, dtype=torch.bool)
    usable[:, :128] = False
    seen, uv = patches.seen(image, sequence.camera, pose, usable)
    free, _ = patches.seen(image, sequence.camera, pose, None)
    assert 0 < int(seen.sum()) < int(free.sum())
    assert float(uv[seen, 0].min()) > 128 - 1.5
    black, uv = patches.seen(np.zeros_like(image), sequence.camera, pose, None)
    assert not black.any()
    assert torch.isfinite(uv).all()


def test_a_point_is_not_claimed_from_the_other_side_or_from_afar():
    sequence = sequence_of()
    recorded = exact_run(sequence)
    patches = patches_of(sequence, recorded)
    T_world_cam = sequence.pose(5).clone()
    middle = patches.xyz[:, MIDDLE].double()
    T_world_cam[:3, 3] = 2 * middle[0] - patches.host[0].double()  # opposite the host, as far away
    seen, _ = patches.seen(sequence.frame(5).image, sequence.camera, T_world_cam, None)
    here, there = middle - T_world_cam[:3, 3], middle - patches.host.double()
    cosine = (here * there).sum(-1) / (here.norm(dim=-1) * there.norm(dim=-1))
    assert float(cosine[0]) < LEAST_COSINE
    assert not seen[0]
    assert bool((cosine[seen] > LEAST_COSINE).all())


def test_where_a_patch_lies_is_measured_to_a_tenth_of_a_pixel_under_any_gain_and_offset():
    """The picture is a smooth one, its points on a sphere about the host; the image is the same one, turned."""
    camera, generator = Equirectangular(512, 256), torch.Generator().manual_seed(0)
    texture = blur(torch.rand(1, 1, 256, 512, generator=generator), camera, 1.5)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    turn_px = 0.6
    beside = camera.pixel_grid() + torch.tensor([turn_px, 0.0])
    shifted = sample(texture, beside[None], camera)
    host, image = (
        (255 * picture).round().to(torch.uint8)[0, 0, ..., None].expand(-1, -1, 3).contiguous().numpy()
        for picture in (texture, 0.5 * shifted + 0.2)
    )
    uv = torch.rand(500, 2, generator=generator, dtype=torch.float64) * torch.tensor([512.0, 120.0]) + torch.tensor(
        [0, 68]
    )
    uv = uv.floor() + 0.5
    eye = torch.eye(4, dtype=torch.float64)
    patches = Patches.empty(500)
    patches.fill(torch.ones(500, dtype=torch.bool), 3 * camera.ray(uv).float(), host, camera, eye)
    seen, found = patches.seen(image, camera, eye, None)
    assert float(seen.float().mean()) > 0.9
    off = found[seen] - uv[seen] + torch.tensor([turn_px, 0.0])
    assert float(off.norm(dim=-1).median()) < 0.1
    same, found = patches.seen(host, camera, eye, None)
    assert float((found - uv)[same].norm(dim=-1).max()) < 0.02
