"""The record of a run: what was said of every frame, and what it stands on, so that later corrections reach it.

Every frame placed on a map is kept relative to one of its keyframes. A keyframe goes on moving while it is in the
window; at the end each frame's pose is its keyframe's final pose and the frame's own place in it. A map has a unit of
its own: its place in the world is a similarity, which is found when one of its keyframes shows a place of another map.
"""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.loop import PoseGraph, PoseGraphConfig, carry_poses, odometry_information, optimise_pose_graph
from torchvo360.vo.keyframes.cloud import PointCloud, join_clouds
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.loops import LoopEdge
from torchvo360.vo.smooth import Standing
from torchvo360.vo.state import FrameEstimate

UNMEASURED = {"residual": math.nan, "inliers": math.nan, "a": math.nan, "b": math.nan}
METRIC_SCALE_SIGMA = 1e-4
"""Drift of scale from keyframe to keyframe where the unit is known."""


class Session(NamedTuple):
    """Keyframes that followed one another in one window."""

    map: int
    after: int | None
    """The keyframe of an earlier session from which this one went on."""
    mapper: Mapper


@dataclass
class Atlas:
    """Frames, and the keyframes of all maps."""

    estimates: list[FrameEstimate] = field(default_factory=list)
    """As they were given out, one a frame."""
    anchors: dict[int, tuple[int, Float64[Tensor, "4 4"]]] = field(default_factory=dict)
    """By frame index: its keyframe, and T_key_cam."""
    sessions: list[Session] = field(default_factory=list)
    """The newest last."""
    S_world_map: list[Float64[Tensor, "4 4"]] = field(default_factory=list)
    oldest: list[int] = field(default_factory=list)
    """By map: the oldest one of those it is joined with."""

    def begin(self, mapper: Mapper, *, map: int | None = None, after: int | None = None) -> None:
        """Begin a session: on an earlier map, after one of its keyframes, or on a new one."""
        if map is None:
            map = len(self.S_world_map)
            self.S_world_map.append(torch.eye(4, dtype=torch.float64))
            self.oldest.append(map)
        self.sessions.append(Session(map, after, mapper))

    def drop_session(self) -> None:
        """Take back the newest session, whose map turned out wrong."""
        gone = self.sessions.pop()
        if all(session.map != gone.map for session in self.sessions):
            self.S_world_map.pop()
            self.oldest.pop()

    def map_of(self, key: int) -> int:
        """Return the map that a keyframe belongs to."""
        return next(session.map for session in reversed(self.sessions) if session.mapper.has(key))

    def mapper_of(self, key: int) -> Mapper:
        """Return the keyframes among which a keyframe was made."""
        return next(session.mapper for session in reversed(self.sessions) if session.mapper.has(key))

    def in_world(self, T_map_cam: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
        """Return the world pose of a camera on the present map."""
        S = self.S_world_map[self.sessions[-1].map]
        return carry_poses(S[None], torch.zeros(1, dtype=torch.int64), lie.se3_normalized(T_map_cam)[None])[0]

    def anchor(self, index: int, key: int, T_key_cam: Float64[Tensor, "4 4"]) -> None:
        """Note where a frame stands."""
        self.anchors[index] = (key, lie.se3_normalized(T_key_cam))

    def fill_in(self, key: int, T_key_cam: dict[int, Float64[Tensor, "4 4"]]) -> None:
        """Place frames that were given out before on a new map: what was measured against another says nothing now."""
        for at, estimate in enumerate(self.estimates):
            if estimate.index in T_key_cam:
                self.anchor(estimate.index, key, T_key_cam[estimate.index])
                self.estimates[at] = replace(estimate, **UNMEASURED)

    def join(self, edge: LoopEdge) -> bool:
        """Place the newer of the two maps that a loop connects, and with it all maps that it is joined with.

        The newer is the one whose oldest companion began later: what is joined with the first map stays. False where
        the loop connects a map with itself, or maps that are joined already: such loops wait for the pose graph.
        """
        map_i, map_j = self.map_of(edge.i), self.map_of(edge.j)
        if map_i == map_j or self.oldest[map_i] == self.oldest[map_j]:
            return False
        poses = self._in_maps()
        # X_world = S_world_i X_i, and X_i = S_j_i^-1 X_j: what j's keyframe sees is where i's says.
        newer, older, S_older_newer = map_j, map_i, poses[edge.i] @ lie.sim3_inverse(poses[edge.j] @ edge.S_j_i)
        if (self.oldest[map_i], map_i) > (self.oldest[map_j], map_j):
            newer, older, S_older_newer = map_i, map_j, lie.sim3_inverse(S_older_newer)
        placed = self.S_world_map[older] @ S_older_newer
        moved, group = placed @ lie.sim3_inverse(self.S_world_map[newer]), self.oldest[newer]
        self.S_world_map[newer] = placed
        for map in (at for at, oldest in enumerate(self.oldest) if oldest == group):
            if map != newer:
                self.S_world_map[map] = moved @ self.S_world_map[map]
            self.oldest[map] = self.oldest[older]
        return True

    def scale_of(self, map: int) -> float:
        """Return the world's units in one unit of a map."""
        return float(torch.linalg.det(self.S_world_map[map][:3, :3])) ** (1 / 3)

    def rescale(self, scale: float) -> None:
        """Give the present map's unit this many of the world's, and with it all maps that it is joined with.

        The oldest keyframe among them stays where it is.

        Args:
            scale: In place of what it was before.
        """
        map = self.sessions[-1].map
        factor, group = scale / self.scale_of(map), self.oldest[map]
        first = next(session.mapper for session in self.sessions if session.map == group).poses()
        centre = (self.S_world_map[group] @ first[min(first)])[:3, 3]
        S = torch.eye(4, dtype=torch.float64)
        S[:3, :3] *= factor
        S[:3, 3] = (1 - factor) * centre
        for at, oldest in enumerate(self.oldest):
            if oldest == group:
                self.S_world_map[at] = S @ self.S_world_map[at]

    def keyframes(self) -> dict[int, Float64[Tensor, "4 4"]]:
        """Return S_world_key of all keyframes, by frame index."""
        return {
            key: self.S_world_map[session.map] @ T
            for session in self.sessions
            for key, T in session.mapper.poses().items()
        }

    def _in_maps(self) -> dict[int, Float64[Tensor, "4 4"]]:
        return {key: T for session in self.sessions for key, T in session.mapper.poses().items()}

    def corrected(
        self, loops: list[LoopEdge], config: PoseGraphConfig, *, metric: bool = False
    ) -> dict[int, Float64[Tensor, "4 4"]]:
        """Return S_world_key of all keyframes after the loops have been closed."""
        nodes = self.keyframes()
        place = {key: at for at, key in enumerate(nodes)}
        loops = [edge for edge in loops if edge.i in place and edge.j in place]
        if not loops:
            return nodes
        poses = self._in_maps()
        chain: list[tuple[int, int]] = []
        for session in self.sessions:
            keys = sorted(session.mapper.poses())
            if session.after is not None and keys:
                chain.append((session.after, keys[0]))
            chain += list(pairwise(keys))
        # Maps of one keyframe each have no chain.
        none = torch.zeros(0, 4, 4, dtype=torch.float64)
        S_chain = torch.cat([none, *((lie.se3_inverse(poses[j]) @ poses[i])[None] for i, j in chain)])
        sigma = {"scale_sigma": METRIC_SCALE_SIGMA} if metric else {}
        graph = PoseGraph(
            S_world_key=torch.stack(list(nodes.values())),
            i=torch.tensor([place[i] for i, _ in chain] + [place[edge.i] for edge in loops]),
            j=torch.tensor([place[j] for _, j in chain] + [place[edge.j] for edge in loops]),
            S_j_i=torch.cat([S_chain, torch.stack([edge.S_j_i for edge in loops])]),
            information=torch.cat(
                [odometry_information(S_chain, **sigma), torch.stack([edge.information for edge in loops])]
            ),
            is_loop=torch.tensor([False] * len(chain) + [True] * len(loops)),
            held=torch.arange(len(nodes)) == 0,
        )
        result = optimise_pose_graph(graph, config)
        return dict(zip(nodes, result.S_world_key, strict=True))

    def final(self, S_world_key: dict[int, Float64[Tensor, "4 4"]]) -> list[FrameEstimate]:
        """Return all estimates with the poses that follow from their keyframes'."""
        place = {key: at for at, key in enumerate(S_world_key)}
        known = [at for at, e in enumerate(self.estimates) if self.anchors.get(e.index, (-1,))[0] in place]
        out = list(self.estimates)
        if not known:
            return out
        anchors = [self.anchors[self.estimates[at].index] for at in known]
        keys = torch.tensor([place[key] for key, _ in anchors])
        poses = carry_poses(torch.stack(list(S_world_key.values())), keys, torch.stack([T for _, T in anchors]))
        for at, T_world_cam in zip(known, poses, strict=True):
            # Of its own: a view would keep all poses alive with any one of them.
            out[at] = replace(out[at], T_world_cam=T_world_cam.clone())
        return out

    def standing(self, S_world_key: dict[int, Float64[Tensor, "4 4"]], points: PointCloud) -> dict[int, Standing]:
        """Return what each frame stands on, by frame index.

        Args:
            S_world_key: Of all keyframes.
            points: All points in the world.
        """
        groups = {key: self.oldest[s.map] for s in self.sessions for key in s.mapper.poses() if key in S_world_key}
        keys = torch.tensor(sorted(groups), dtype=torch.int64)
        centre = torch.stack([S_world_key[int(key)][:3, 3] for key in keys]) if len(keys) else torch.zeros(0, 3)
        at = torch.searchsorted(keys, points.frame.long())
        distance = torch.linalg.vector_norm(points.xyz - centre[at], dim=-1)
        group = torch.tensor([groups[int(key)] for key in keys], dtype=torch.int64)[at]
        ranges = {
            number: float(distance[group == number].median()) if bool((group == number).any()) else 1.0
            for number in set(groups.values())
        }
        scales = {key: float(torch.linalg.det(S_world_key[key][:3, :3])) ** (1 / 3) for key in groups}
        return {
            index: Standing(groups[key], scales[key], ranges[groups[key]])
            for index, (key, _) in self.anchors.items()
            if key in groups
        }

    def points(self, S_world_key: dict[int, Float64[Tensor, "4 4"]]) -> PointCloud:
        """Return the points of all maps in the world."""
        clouds = {key: cloud for session in self.sessions for key, cloud in session.mapper.all_clouds().items()}
        return join_clouds([cloud.moved(S_world_key[key]) for key, cloud in clouds.items()])
