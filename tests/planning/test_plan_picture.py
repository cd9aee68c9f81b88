"""The picture of a plan: its colours are where they belong."""

import cv2
import numpy as np
import pytest
import torch

from torchvo360.mapping import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from torchvo360.planning import PlanConfig, clearance_of, plan_path
from torchvo360.planning.picture import OBSTACLE, UNSEEN, WAY, draw_plan

pytest.importorskip("matplotlib")


def share_of(image, colour):
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    return float((np.abs(image.astype(int) - rgb).max(-1) <= 2).mean())


@pytest.mark.parametrize("goal", [(5.0, 1.0), (9.0, 1.0), (2.95, 0.5)])
def test_a_plan_is_drawn_with_or_without_a_way(tmp_path, goal):
    states = torch.full((40, 60), FREE, dtype=torch.int8)
    states[:28, 28:31], states[:, :10] = OCCUPIED, UNKNOWN
    map = OccupancyMap(states, 0.1)
    plan = plan_path(map, (1.5, 1.0), goal, PlanConfig(backend="python"))
    camera = torch.tensor([[1.0, 1.0], [2.0, 2.0]], dtype=torch.float64)
    path = tmp_path / "plan.png"
    draw_plan(path, map, clearance_of(map, PlanConfig()), plan, ends=((1.5, 1.0), goal), camera_path=camera)
    read = cv2.imread(str(path))
    assert read is not None
    image = read[..., ::-1]
    assert min(image.shape[:2]) > 300
    assert share_of(image, OBSTACLE) > 0.005
    assert share_of(image, UNSEEN) > 0.02
    assert (share_of(image, WAY) > 2e-4) == plan.found or plan.nearest is not None


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1)])
def test_maps_of_any_shape_are_drawn(tmp_path, shape):
    map = OccupancyMap(torch.zeros(shape, dtype=torch.int8), 0.05)
    end = (shape[1] * 0.05 - 0.01, shape[0] * 0.05 - 0.01)
    config = PlanConfig(robot_radius=0.0, backend="python")
    plan = plan_path(map, (0.01, 0.01), end, config)
    draw_plan(tmp_path / "plan.png", map, clearance_of(map, config), plan, ends=((0.01, 0.01), end), unit="units")
    assert cv2.imread(str(tmp_path / "plan.png")) is not None
