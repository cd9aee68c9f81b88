"""The record of a run: frames follow their keyframes, maps find their place and size, loops move what hangs on them."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.loop import PoseGraphConfig, carry_poses
from torchvo360.vo import FrameEstimate, State
from torchvo360.vo.atlas import Atlas
from torchvo360.vo.keyframes.cloud import PointCloud
from torchvo360.vo.loops import LoopEdge

EYE = torch.eye(4, dtype=torch.float64)
CONFIG = PoseGraphConfig()


@dataclass
class Keys:
    """A mapper as the atlas sees it: keyframes that can be moved."""

    T: dict[int, Tensor]
    clouds: dict[int, PointCloud] = field(default_factory=dict)

    def poses(self) -> dict[int, Tensor]:
        return dict(self.T)

    def has(self, key: int) -> bool:
        return key in self.T

    def all_clouds(self) -> dict[int, PointCloud]:
        return dict(self.clouds)


def motion(*xi: float) -> Tensor:
    return lie.se3_exp(torch.tensor(xi, dtype=torch.float64))


def similarity(scale: float, *xi: float) -> Tensor:
    S = motion(*xi)
    S[:3, :3] *= scale
    return S


def circle(count: int) -> list[Tensor]:
    """T_world_key on a circle of 2 m that begins at the origin, turned along it."""
    poses = []
    for k in range(count):
        angle = math.tau * k / count
        R = lie.so3_exp(torch.tensor([0.1 * math.sin(angle), angle, 0.0], dtype=torch.float64))
        centre = [2 * math.sin(angle), 0.1 * math.sin(2 * angle), 2 - 2 * math.cos(angle)]
        poses.append(lie.se3(R, torch.tensor(centre, dtype=torch.float64)))
    return poses


def seen_from(S_world_map: Tensor, T_world: Tensor) -> Tensor:
    """Return a pose in a map of its own place and unit."""
    return carry_poses(lie.sim3_inverse(S_world_map)[None], torch.zeros(1, dtype=torch.int64), T_world[None])[0]


def estimate(index: int, T: Tensor = EYE) -> FrameEstimate:
    return FrameEstimate(index, index, T.clone(), State.TRACKING, "ok", 0.01, 0.9, 0.1, 0.0, 1.0)


def edge(i: int, j: int, S_j_i: Tensor) -> LoopEdge:
    return LoopEdge(i, j, S_j_i, 1e6 * torch.eye(7, dtype=torch.float64))


S_SECOND = similarity(2.5, 1.0, -2.0, 0.5, 0.4, 2.0, -0.3)
"""S_world_map of a second map whose unit is 2.5 of the first one's."""


def two_maps() -> tuple[Atlas, list[Tensor]]:
    """Keyframes 0 to 9 in a first map, 10 to 19 in a second that does not know its place; and all their true poses."""
    true = circle(20)
    atlas = Atlas()
    atlas.begin(Keys(dict(enumerate(true[:10]))))
    atlas.begin(Keys({10 + k: seen_from(S_SECOND, T) for k, T in enumerate(true[10:])}))
    return atlas, true


def between_maps(atlas: Atlas, i: int, j: int, true: list[Tensor]) -> LoopEdge:
    """The exact loop: X_world = S_world_map T_map_key X_key for both."""
    S = [EYE if key < 10 else S_SECOND for key in (i, j)]
    poses = {key: T for session in atlas.sessions for key, T in session.mapper.poses().items()}
    return edge(i, j, lie.sim3_inverse(S[1] @ poses[j]) @ S[0] @ poses[i])


# Anchors


def test_a_frame_follows_its_keyframe_and_the_keyframe_s_own_frame_is_where_that_is():
    keys = Keys({0: EYE, 4: motion(0.0, 0.0, 1.0, 0.0, 0.2, 0.0)})
    atlas = Atlas()
    atlas.begin(keys)
    T_key_cam = motion(0.1, 0.0, 0.3, 0.0, 0.05, 0.1)
    for index, (key, T) in {0: (0, EYE), 4: (4, EYE), 5: (4, T_key_cam)}.items():
        atlas.estimates.append(estimate(index))
        atlas.anchor(index, key, T)
    keys.T[4] = motion(0.2, 0.1, 1.1, 0.1, 0.3, 0.0)
    frames = atlas.final(atlas.keyframes())
    torch.testing.assert_close(frames[1].T_world_cam, keys.T[4])
    torch.testing.assert_close(frames[2].T_world_cam, keys.T[4] @ T_key_cam)
    torch.testing.assert_close(frames[0].T_world_cam, EYE)


def test_frames_without_a_keyframe_keep_their_pose():
    atlas = Atlas()
    online = motion(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    atlas.estimates.append(estimate(0, online))
    assert torch.equal(atlas.final(atlas.keyframes())[0].T_world_cam, online), "no map at all"
    atlas.begin(Keys({1: motion(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}))
    atlas.estimates += [estimate(1), estimate(2, online)]
    atlas.anchor(1, 1, EYE)
    atlas.anchor(2, 77, EYE)  # of a map that was taken back
    frames = atlas.final(atlas.keyframes())
    assert torch.equal(frames[0].T_world_cam, online)
    assert torch.equal(frames[2].T_world_cam, online)
    assert float(frames[1].T_world_cam[2, 3]) == 1.0


def test_final_poses_are_rigid_and_their_own_whatever_the_unit_of_their_map():
    atlas, true = two_maps()
    atlas.join(between_maps(atlas, 3, 15, true))
    for k in range(20):
        atlas.estimates.append(estimate(k))
        atlas.anchor(k, k, motion(0.0, 0.0, 0.01 * k, 0.0, 0.0, 0.0))
    for frame in atlas.final(atlas.keyframes()):
        R = frame.T_world_cam[:3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
        assert frame.T_world_cam.untyped_storage().nbytes() == 8 * 16


def test_frames_of_another_unit_move_by_their_share_of_it():
    atlas, true = two_maps()
    atlas.join(between_maps(atlas, 3, 15, true))
    atlas.estimates += [estimate(10), estimate(11)]
    atlas.anchor(10, 10, EYE)
    atlas.anchor(11, 10, motion(0.0, 0.0, 0.2, 0.0, 0.0, 0.0))
    first, second = (frame.T_world_cam[:3, 3] for frame in atlas.final(atlas.keyframes()))
    assert float((second - first).norm()) == pytest.approx(0.2 * 2.5)


def test_frames_given_out_before_a_map_are_placed_on_it_and_what_was_measured_is_taken_back():
    atlas = Atlas(estimates=[estimate(k) for k in range(3)])
    atlas.begin(Keys({1: EYE}))
    T_key_cam = motion(0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
    atlas.fill_in(1, {1: EYE, 2: T_key_cam, 9: EYE})
    assert atlas.estimates[0].residual == 0.01
    for at in (1, 2):
        told = atlas.estimates[at]
        assert all(math.isnan(value) for value in (told.residual, told.inliers, told.a, told.b))
    torch.testing.assert_close(atlas.final(atlas.keyframes())[2].T_world_cam, T_key_cam)
    assert 9 not in atlas.anchors


# Maps


@pytest.mark.parametrize("backwards", [False, True], ids=["newer_sees_older", "older_sees_newer"])
def test_a_joined_map_lands_where_it_should_its_scale_included(backwards):
    """The newer map is placed, whichever of the two keyframes is called j."""
    atlas, true = two_maps()
    i, j = (15, 3) if backwards else (3, 15)
    assert atlas.join(between_maps(atlas, i, j, true))
    torch.testing.assert_close(atlas.S_world_map[1], S_SECOND)
    torch.testing.assert_close(atlas.S_world_map[0], EYE)
    keys = atlas.keyframes()
    for k in range(20):
        torch.testing.assert_close(keys[k][:3, 3], true[k][:3, 3])
    torch.testing.assert_close(torch.linalg.det(keys[15][:3, :3]).pow(1 / 3), torch.tensor(2.5, dtype=torch.float64))
    torch.testing.assert_close(atlas.in_world(seen_from(S_SECOND, true[12])), true[12])


def test_a_third_map_is_placed_by_a_second_that_has_been_placed():
    atlas, true = two_maps()
    S_third = similarity(0.4, -1.0, 0.0, 2.0, 0.0, -1.0, 0.2)
    atlas.begin(Keys({20: seen_from(S_third, true[5])}))
    atlas.join(between_maps(atlas, 3, 15, true))
    second = S_SECOND @ atlas.sessions[1].mapper.poses()[14]
    third = S_third @ atlas.sessions[2].mapper.poses()[20]
    assert atlas.join(edge(14, 20, lie.sim3_inverse(third) @ second))
    torch.testing.assert_close(atlas.S_world_map[2], S_third)


@pytest.mark.parametrize("by", [1, 2], ids=["by_itself", "by_its_companion"])
def test_maps_that_are_joined_move_together(by):
    """A second and a third map know each other; once either is seen from the first, both are placed."""
    atlas, true = two_maps()
    S = [EYE, S_SECOND, similarity(0.4, -1.0, 0.0, 2.0, 0.0, -1.0, 0.2)]
    third = {20 + k: seen_from(S[2], T) for k, T in enumerate(true[5:8])}
    atlas.begin(Keys(third))
    poses = {**atlas.sessions[0].mapper.poses(), **atlas.sessions[1].mapper.poses(), **third}

    def seen(i: int, j: int) -> LoopEdge:
        (S_i, S_j) = (S[min(key // 10, 2)] @ poses[key] for key in (i, j))
        return edge(i, j, lie.sim3_inverse(S_j) @ S_i)

    assert atlas.join(seen(14, 20))
    assert atlas.join(seen(3, 15 if by == 1 else 21))
    for placed, expected in zip(atlas.S_world_map, S, strict=True):
        torch.testing.assert_close(placed, expected)


def test_a_map_that_has_its_place_is_not_torn_off_by_one_that_has_none():
    atlas, true = two_maps()
    S_third = similarity(0.4, -1.0, 0.0, 2.0, 0.0, -1.0, 0.2)
    atlas.begin(Keys({20: seen_from(S_third, true[5])}))
    poses = {key: T for session in atlas.sessions for key, T in session.mapper.poses().items()}
    third, second = S_third @ poses[20], S_SECOND @ poses[14]
    atlas.join(edge(3, 20, lie.sim3_inverse(third) @ poses[3]))
    atlas.join(edge(14, 20, lie.sim3_inverse(third) @ second))
    torch.testing.assert_close(atlas.S_world_map[2], S_third)
    torch.testing.assert_close(atlas.S_world_map[1], S_SECOND)


def test_maps_of_one_keyframe_each_are_corrected_too():
    atlas = Atlas()
    atlas.begin(Keys({0: EYE}))
    atlas.begin(Keys({5: EYE}))
    loop = edge(0, 5, similarity(2.0, 0.0, 0.0, 1.0, 0.0, 0.1, 0.0))
    assert atlas.join(loop)
    after = atlas.corrected([loop], CONFIG)
    torch.testing.assert_close(after[5], lie.sim3_inverse(loop.S_j_i))


def test_a_loop_within_a_map_joins_nothing():
    atlas, _ = two_maps()
    assert not atlas.join(edge(0, 9, EYE))
    assert not atlas.join(edge(19, 10, EYE))
    assert all(torch.equal(S, EYE) for S in atlas.S_world_map)
    atlas.begin(Keys({30: EYE}), map=0, after=9)
    assert atlas.map_of(30) == 0
    assert not atlas.join(edge(2, 30, EYE)), "a later session on the first map"


def test_dropping_a_session_takes_its_map_back_and_leaves_earlier_ones():
    atlas, _ = two_maps()
    atlas.estimates += [estimate(9), estimate(15)]
    atlas.anchor(9, 9, EYE)
    atlas.anchor(15, 15, EYE)
    atlas.begin(Keys({30: EYE}), map=0, after=9)
    atlas.drop_session()
    assert len(atlas.S_world_map) == 2, "the first map has its other keyframes"
    atlas.drop_session()
    assert len(atlas.S_world_map) == 1
    assert set(atlas.keyframes()) == set(range(10))
    assert torch.equal(atlas.final(atlas.keyframes())[1].T_world_cam, EYE)
    atlas.begin(Keys({31: EYE}))
    assert atlas.map_of(31) == 1


def test_the_points_of_a_joined_map_have_the_first_one_s_unit():
    atlas, true = two_maps()
    p_world = torch.tensor([[0.3, -1.0, 2.0]], dtype=torch.float64)
    for session, S in zip(atlas.sessions, (EYE, S_SECOND), strict=True):
        for key, T in session.mapper.poses().items():
            S_key_world = lie.sim3_inverse(S @ T)
            xyz = p_world @ S_key_world[:3, :3].mT + S_key_world[:3, 3]
            session.mapper.clouds[key] = PointCloud(
                xyz.float(), torch.zeros(1, 3, dtype=torch.uint8), torch.tensor([key]).int()
            )
    atlas.join(between_maps(atlas, 3, 15, true))
    cloud = atlas.points(atlas.keyframes())
    torch.testing.assert_close(cloud.xyz, p_world.float().expand(20, 3), rtol=0, atol=1e-5)


def test_a_map_that_learns_its_metre_grows_about_its_first_keyframe():
    atlas = Atlas()
    start = motion(1.0, 2.0, 3.0, 0.0, 0.5, 0.0)
    atlas.begin(Keys({0: start, 1: start @ lie.se3(EYE[:3, :3], torch.tensor([0.0, 0.0, 1.0]).double())}))
    for scale in (2.0, 3.0):
        atlas.rescale(scale)
        after = atlas.keyframes()
        assert atlas.scale_of(0) == pytest.approx(scale)
        torch.testing.assert_close(after[0][:3, 3], start[:3, 3])
        assert float((after[1][:3, 3] - start[:3, 3]).norm()) == pytest.approx(scale)


def test_maps_that_are_joined_learn_the_metre_together():
    atlas, true = two_maps()
    atlas.join(between_maps(atlas, 3, 15, true))
    before = atlas.keyframes()
    atlas.rescale(2.0 * atlas.scale_of(1))
    after = atlas.keyframes()
    for k in range(20):
        torch.testing.assert_close(after[k][:3, 3], 2.0 * (before[k][:3, 3] - before[0][:3, 3]) + before[0][:3, 3])
    assert atlas.scale_of(0) == pytest.approx(2.0)


# Loops


def drifted(count: int = 24, *, scale: float = 1.01) -> tuple[Atlas, list[Tensor], LoopEdge]:
    """A walk around a circle, every step a little too long and turned a little, with the loop that closes it."""
    true = circle(count)
    poses, size = [EYE], 1.0
    for before, after in pairwise(true):
        step = lie.se3_inverse(before) @ after @ motion(0.0, 0.0, 0.0, 0.0003, 0.001, 0.0)
        size *= scale
        poses.append(poses[-1] @ lie.se3(step[:3, :3], step[:3, 3] * size))
    atlas = Atlas()
    atlas.begin(Keys(dict(enumerate(poses))))
    S_j_i = lie.se3_inverse(true[-1]) @ true[0]
    S_j_i[:3] = torch.cat([S_j_i[:3, :3] * size, S_j_i[:3, 3:] * size], 1)
    return atlas, true, edge(0, count - 1, S_j_i)


def test_without_loops_nothing_is_corrected():
    atlas, _, _ = drifted()
    before = atlas.keyframes()
    for loops in ([], [edge(0, 99, EYE)]):
        after = atlas.corrected(loops, CONFIG)
        assert all(torch.equal(after[key], before[key]) for key in before)


def test_a_loop_takes_the_drift_back_and_the_frames_between_keyframes_go_along():
    atlas, true, loop = drifted()
    halfway = motion(0.02, 0.0, 0.2, 0.0, 0.1, 0.0)
    for k in range(24):
        atlas.estimates += [estimate(2 * k), estimate(2 * k + 1)]
        atlas.anchor(2 * k, k, EYE)
        atlas.anchor(2 * k + 1, k, halfway)
    before, after = atlas.keyframes(), atlas.corrected([loop], CONFIG)
    gap = [float((keys[23][:3, 3] - true[23][:3, 3]).norm()) for keys in (before, after)]
    assert gap[0] > 0.4
    assert gap[1] < 0.01 * gap[0]
    torch.testing.assert_close(after[0], EYE, rtol=0, atol=1e-9)
    frames = atlas.final(after)
    for k in range(24):
        at_key, later = (frames[2 * k + more].T_world_cam for more in (0, 1))
        torch.testing.assert_close(at_key[:3, 3], after[k][:3, 3])
        size = torch.linalg.det(after[k][:3, :3]).pow(1 / 3)
        relative = lie.se3_inverse(at_key) @ later
        torch.testing.assert_close(relative[:3, :3], halfway[:3, :3], rtol=0, atol=1e-9)
        torch.testing.assert_close(relative[:3, 3], halfway[:3, 3] * size, rtol=0, atol=1e-9)
    earlier = atlas.final(before)
    # What was before the loops is still to be had.
    torch.testing.assert_close(earlier[46].T_world_cam, before[23])


def test_where_the_metre_is_known_a_loop_changes_no_scale():
    atlas, _, loop = drifted(scale=1.0)
    spoiled = loop._replace(
        S_j_i=loop.S_j_i @ similarity(1.05, 0, 0, 0, 0, 0, 0), information=1e2 * loop.information / 1e6
    )
    sizes = {}
    for metric in (False, True):
        keys = atlas.corrected([spoiled], CONFIG, metric=metric)
        sizes[metric] = max(abs(float(torch.linalg.det(T[:3, :3]).pow(1 / 3)) - 1) for T in keys.values())
    assert sizes[True] < 1e-4
    assert sizes[False] > 1e-3


def test_a_loop_leaves_a_map_alone_that_nothing_ties_to_it():
    atlas, _, loop = drifted()
    alone = {40 + k: T for k, T in enumerate(circle(5))}
    atlas.begin(Keys(alone))
    after = atlas.corrected([loop], CONFIG)
    assert float((after[23][:3, 3] - atlas.keyframes()[23][:3, 3]).norm()) > 0.2
    for key, T in alone.items():
        torch.testing.assert_close(after[key], T, rtol=0, atol=1e-9)


def test_a_session_after_a_relocalisation_moves_with_the_keyframe_it_went_on_from():
    atlas, _, loop = drifted()
    poses = atlas.keyframes()
    step = motion(0.0, 0.0, 0.3, 0.0, 0.2, 0.0)
    atlas.begin(Keys({30: poses[20] @ step, 31: poses[20] @ step @ step}), map=0, after=20)
    after = atlas.corrected([loop], CONFIG)
    for key, expected in ((30, step), (31, step @ step)):
        S = lie.sim3_inverse(after[20]) @ after[key]
        torch.testing.assert_close(S, expected, rtol=0, atol=1e-3)
    assert float((after[30][:3, 3] - (poses[20] @ step)[:3, 3]).norm()) > 0.1


def test_loops_between_maps_correct_both_and_keep_their_scales_apart():
    """Two loops that tell nearly the same of the second map: the scale between the maps is found, not averaged away."""
    atlas, true = two_maps()
    loops = [between_maps(atlas, 3, 15, true), between_maps(atlas, 8, 11, true)]
    atlas.join(loops[0])
    atlas.S_world_map[1] = atlas.S_world_map[1] @ similarity(1.1, 0.05, 0.0, 0.0, 0.0, 0.05, 0.0)
    after = atlas.corrected(loops, CONFIG)
    for k in range(20):
        torch.testing.assert_close(after[k][:3, 3], true[k][:3, 3], rtol=0, atol=5e-3)
        size = float(torch.linalg.det(after[k][:3, :3]).pow(1 / 3))
        assert size == pytest.approx(1.0 if k < 10 else 2.5, rel=5e-3)
