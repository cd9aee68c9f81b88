"""Loops: every keyframe that leaves the window is compared with the places seen before."""

from dataclasses import dataclass, field
from typing import NamedTuple

from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError
from torchvo360.loop import (
    LoopFrame,
    PlaceIndex,
    PoseGraphConfig,
    VerifyConfig,
    describe_place,
    make_loop_frame,
    verify_loop,
)
from torchvo360.vo.frame import FrameBuilder
from torchvo360.vo.keyframes.keyframe import Keyframe


@dataclass(kw_only=True)
class LoopConfig:
    """Settings of loop closing."""

    enabled: bool = True
    """Look for places seen before, correct the trajectory by them, and join maps."""
    min_gap: int = 12
    """A keyframe is not compared with this many before it: they show the same place in any case."""
    tried: int = 2
    """Most like places that are verified for each keyframe."""
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)

    def __post_init__(self) -> None:
        if self.min_gap < 1 or self.tried < 1:
            raise InputError(f"min_gap, tried: expected at least 1 each, got {self.min_gap} and {self.tried}.")


class LoopEdge(NamedTuple):
    """A verified loop: keyframe j sees what keyframe i saw."""

    i: int
    j: int
    S_j_i: Float64[Tensor, "4 4"]
    """X_j = S_j_i X_i, each in its own map's unit."""
    information: Float64[Tensor, "7 7"]


class LoopCloser:
    """The places seen so far, and the loops among them."""

    def __init__(self, builder: FrameBuilder, config: LoopConfig) -> None:
        self._config = config
        self._camera = builder.cameras[-1]
        self._index = PlaceIndex(self._camera)
        self._frames: dict[int, LoopFrame] = {}
        self.edges: list[LoopEdge] = []

    def add(self, key: Keyframe) -> list[LoopEdge]:
        """Look for the place of a keyframe that goes no further, and remember it; return the loops it closes."""
        if not self._config.enabled or key.frame.index in self._frames:
            return []
        place, descriptor = self._described(key)
        found = self._search(key.frame.index, place, descriptor, self._config.min_gap)
        self._index.add(key.frame.index, descriptor)
        self._frames[key.frame.index] = place
        self.edges += found
        return found

    def search(self, keys: list[Keyframe]) -> list[LoopEdge]:
        """Return the loops that keyframes still in the window would close, the oldest first; remember nothing."""
        out: list[LoopEdge] = []
        for at, key in enumerate(keys):
            if self._config.enabled and key.frame.index not in self._frames:
                out += self._search(key.frame.index, *self._described(key), max(0, self._config.min_gap - at))
        return out

    def forget(self, keys: set[int]) -> None:
        """Forget keyframes of a map that turned out wrong, and the loops they closed."""
        for key in keys & set(self._frames):
            del self._frames[key]
        self._index.keep(self._frames.keys())
        self.edges = [edge for edge in self.edges if not {edge.i, edge.j} & keys]

    def _described(self, key: Keyframe) -> tuple[LoopFrame, Tensor]:
        target = key.frame.targets[-1]
        known = None if target.confidence is None else target.confidence[0, 0, 1:-1, 1:-1] > 0.5
        rho, variance, _ = key.points
        place = make_loop_frame(key.T_world_key, key.frame.targets, key.ray, rho, variance)
        return place, describe_place(target.padded[0, 0, 1:-1, 1:-1], self._camera, known)

    def _search(self, index: int, place: LoopFrame, descriptor: Tensor, skip: int) -> list[LoopEdge]:
        out = []
        for candidate in self._index.query(descriptor, skip_newest=skip, count=self._config.tried):
            # Where intrinsics are estimated, the newest know them best.
            earlier = self._frames[candidate.key_id].recalibrated(place.cameras)
            result = verify_loop(earlier, place, self._config.verify)
            if result.accepted:
                out.append(LoopEdge(candidate.key_id, index, result.S_b_a, result.information))
        return out
