"""What points meet in the images: all that an agreement or an outlier test asks, without derivatives by the pose."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from torchvo360.residuals.direct import Reference, Target, look_up


class Comparison(NamedTuple):
    """Samples in the target."""

    residual: Float[Tensor, "B C N"]
    value: Float[Tensor, "B C N"]
    """The target's, less the offset b."""
    weight: Float[Tensor, "B C N"]
    """The points' weights times the target's confidence, 0 out of view; the channels' axis may be 1."""
    slope2: Float[Tensor, "B C N"]
    """Squared gradient of the target, per pixel of the image's middle."""


def compare(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"], affine: Float[Tensor, "B 2"]
) -> Comparison:
    """Warp the reference points into the targets and compare, in eager torch.

    Args:
        reference: Points.
        target: Images.
        T_tgt_ref: Poses.
        affine: (a, b) of each pair.
    """
    dtype = reference.value.dtype
    samples = look_up(reference, target, T_tgt_ref.to(dtype), affine.to(dtype))
    Gx, Gy, Gz = samples.G
    slope2 = (Gx * Gx + Gy * Gy + Gz * Gz) * target.camera.pixel_angle**2
    return Comparison(samples.residual, samples.residual + samples.gained, samples.weight, slope2)
