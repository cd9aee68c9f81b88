"""Upright axes and the height of the floor, from the cameras' attitude and what they saw below them.

The floor is the depth at which the most points lie of those that the camera passed over. Walls and furniture beside
the path are no part of that: a point counts if it lies within a cone below some place of the path. Where no gravity is
known the plane through the floor's points tells what is upright.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError, check_pose, check_shape
from torchvo360.lie import se3
from torchvo360.mapping.rays import Rays

CONES = (1.5, 3.0)
"""Horizontal over vertical distance from the path within which points lie below it; the second where the first holds
too few. Source: in a real corridor 32 of 37 points in the first lie on the floor, in the second 70 of 396."""

MOST_TILT_DEG = 12.0
"""How far from upright a hand holds a camera on average."""

MOST_POINTS, MOST_PLACES = 20_000, 300
"""More points, or places on the path, change the floor little."""

BINS, LEAST_DEPTH_SHARE = 120, 0.03
"""Steps of the depth's logarithm, from this share of the greatest depth on: 3 % each."""

WINDOW = 5
"""Steps, 15 %, within which points belong to one floor: ranges of a few percent and uneven ground."""

CLEAR_SHARE, CLEAR_POINTS = 0.35, 25
"""Share and number of the points in the first cone by which a floor stands out. Source: 0.86 of 1,100 in a rendered
hall, 0.8 of 37 in a corridor whose floor is masked near the camera."""

TILT_POINTS = 200
"""Fewer points in the first cone do not tell the upward direction: 37 of a corridor turned it by 3 degrees."""

NEAR_SHARES = (0.2, 0.15, 0.1, 0.05)
"""Of the cameras' height: how near points have to be to the floor, as it gets better known."""


@dataclass(frozen=True)
class Floor:
    """A level plane below the cameras."""

    up: Float64[Tensor, "3"]
    """Its normal, a unit vector in the world."""
    camera_height: float
    """Median height of the cameras above it."""
    height: float
    """Its place along `up`: points p of the floor have `up @ p == height`."""
    clear: bool
    """Whether it stands out among all that lies below the cameras."""


def upright_axes(
    T_world_cam: Float64[Tensor, "N 4 4"], up: Float64[Tensor, "3"] | None = None
) -> Float64[Tensor, "3 3"]:
    """Return R_map_world: rows right, forward and up, forward as the first camera looks.

    Args:
        T_world_cam: Poses of the cameras, which are held upright on average unless `up` is known.
        up: Upwards in the world, of any length.

    Raises:
        InputError: There is no pose, or `up` has no direction.
    """
    check_pose("T_world_cam", T_world_cam)
    if not len(T_world_cam):
        raise InputError("T_world_cam: expected at least one pose, got none.")
    if up is None:
        up = -T_world_cam[:, :3, 1].mean(0)
        if float(up.norm()) < 0.1:  # they look everywhere
            up = -T_world_cam[0, :3, 1]
    check_shape("up", up, "3")
    length = float(up.norm())
    if not (math.isfinite(length) and length > 0):
        raise InputError(f"up: expected a direction, got {up.tolist()}.")
    up = up.double() / length
    first = T_world_cam[0].double()
    forward = first[:3, 2] - up * (up @ first[:3, 2])
    if float(forward.norm()) < 0.1:  # it looks straight up or down: what is above its image lies ahead
        forward = -first[:3, 1] + up * (up @ first[:3, 1])
    forward = forward / forward.norm()
    return torch.stack([torch.linalg.cross(forward, up), forward, up])


def map_frame(
    T_world_cam: Float64[Tensor, "N 4 4"], up: Float64[Tensor, "3"], floor_height: float, scale: float = 1.0
) -> Float64[Tensor, "4 4"]:
    """Return the similarity S_map_world: x right, y forward, z up, the origin on the floor below the first camera.

    Args:
        T_world_cam: Poses of the cameras.
        up: Upwards in the world.
        floor_height: The floor's place along `up`, in the world's unit.
        scale: Units of the map per unit of the world.
    """
    R_map_world = upright_axes(T_world_cam, up)
    first = R_map_world @ T_world_cam[0, :3, 3]
    foot = torch.stack([first[0], first[1], first.new_tensor(floor_height)])
    return se3(scale * R_map_world, -scale * foot)


def find_floor(
    rays: Rays, path: Float64[Tensor, "P 3"], up: Float64[Tensor, "3"], *, tilt: bool = True
) -> Floor | None:
    """Find the floor among the points that lie below the path.

    Args:
        rays: What was seen, in the world.
        path: Camera centres.
        up: Upwards in the world, as far as it is known.
        tilt: Let the floor tell the upward direction better, within 12 degrees, where many points of it stand out.

    Returns:
        The floor; None where nothing was seen below the path.

    Raises:
        ShapeError: The path is not [P, 3].
    """
    check_shape("path", path, "P 3")
    up = up / up.norm()
    places = path[:: -(-len(path) // MOST_PLACES) or 1]
    points = rays.points[:: -(-len(rays) // MOST_POINTS) or 1]
    point, offset = _below(points, places, up, CONES[0])
    enough = len(point) >= CLEAR_POINTS
    if not enough:
        point, offset = _below(points, places, up, CONES[1])
    if not len(point):
        return None
    depth = -(offset @ up)
    count, level = _most_common(depth)
    clear = enough and count >= CLEAR_SHARE * len(point)
    near = (depth - level).abs() <= 0.1 * level
    height = float((point[near] @ up).median() if bool(near.any()) else (path @ up).median() - level)
    normal = up
    if clear:
        normal, height = _refined(point, up, height, level, tilt=tilt and len(point) >= TILT_POINTS)
    camera_height = float((path @ normal).median()) - height
    return Floor(normal, camera_height, height, clear) if camera_height > 0 else None


def _below(
    points: Float64[Tensor, "N 3"], places: Float64[Tensor, "P 3"], up: Float64[Tensor, "3"], cone: float
) -> tuple[Float64[Tensor, "M 3"], Float64[Tensor, "M 3"]]:
    """Return the points in the cones below places, and their offsets from the nearest one."""
    flat = torch.eye(3, dtype=torch.float64) - up[:, None] * up
    distance, nearest = torch.cdist(points @ flat, places @ flat).min(1)
    offset = points - places[nearest]
    below = -(offset @ up) * cone > distance
    return points[below], offset[below]


def _most_common(depth: Float64[Tensor, "N"]) -> tuple[int, float]:
    """Return how many points the fullest window of depths holds, and its middle; depths are above 0."""
    greatest = depth.quantile(0.98) * 1.2
    low = (greatest * LEAST_DEPTH_SHARE).log()
    step = (greatest.log() - low) / BINS
    bin = ((depth.log() - low) / step).floor().long()
    counts = torch.bincount(bin[(bin >= 0) & (bin < BINS)], minlength=BINS)
    count, at = counts.unfold(0, WINDOW, 1).sum(-1).max(0)
    return int(count), float(((at + WINDOW / 2) * step + low).exp())


def _refined(
    points: Float64[Tensor, "N 3"], normal: Float64[Tensor, "3"], height: float, depth: float, *, tilt: bool
) -> tuple[Float64[Tensor, "3"], float]:
    """Return normal and height of the plane through the points near a plane, each time a little nearer.

    Args:
        points: Those below the path.
        normal: Of the plane to begin with.
        height: Its place along the normal.
        depth: The cameras' height above it, the measure of what is near.
        tilt: Turn the normal, too.
    """
    most = math.cos(math.radians(MOST_TILT_DEG))
    upright = normal
    for share in NEAR_SHARES:
        near = points[(points @ normal - height).abs() < share * depth]
        if len(near) < CLEAR_POINTS:
            break
        if tilt:
            flat = torch.linalg.svd(near - near.mean(0), full_matrices=False)[2][2]
            flat = flat * torch.sign(flat @ upright)
            if float(flat @ upright) < most:  # no floor, or a strip of it, which any plane holds
                break
            normal = flat
        height = float((near @ normal).median())
    return normal, height
