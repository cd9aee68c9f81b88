"""`align` against exact poses: a rendered house with exposure jumps, and a thousand random pairs."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360 import AlignResult, Equirectangular, Status, align, lie
from torchvo360.data.synthetic import WORLDS, sample_pairs
from torchvo360.data.tum import read_tum


class Errors(NamedTuple):
    """How far solutions are from the truth."""

    deg: Float[Tensor, "N"]
    metres: Float[Tensor, "N"]
    converged: Bool[Tensor, "N"]


def errors_of(result: AlignResult, T_true: Float[Tensor, "N 4 4"]) -> Errors:
    E = result.T_tgt_ref @ lie.se3_inverse(T_true)
    metres = (result.T_tgt_ref - T_true)[:, :3, 3].norm(dim=-1)
    return Errors(lie.so3_angle(E[:, :3, :3]).rad2deg(), metres, result.status == Status.CONVERGED)


def summary(errors: Errors) -> str:
    deg, metres, converged = errors
    worst = f"worst {deg.max():.4f} deg, {metres.max():.5f}; converged {int(converged.sum())} of {len(deg)}"
    return f"median {deg.median():.4f} deg, {metres.median():.5f}; {worst}"


def joined(parts: list[Errors]) -> Errors:
    return Errors(*(torch.cat(column) for column in zip(*parts, strict=True)))


@pytest.mark.slow
def test_the_house_is_aligned_from_the_identity(shared: Path):
    house = shared / "data" / "house"
    if not house.is_dir():
        pytest.skip("the house is not among the shared data")
    camera, truth = Equirectangular(1024, 512), read_tum(house / "poses.txt").T_world_cam

    def image(index: int) -> Float[Tensor, "1 1 H W"]:
        gray = cv2.imread(str(house / f"images/{index:06d}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        return torch.from_numpy(gray.astype(np.float32) / 255)[None, None]

    found = []
    for file in sorted((house / "depth").glob("*.npz")):
        k = int(file.stem)
        with np.load(file, allow_pickle=False) as arrays:
            rho = 1 / torch.from_numpy(arrays["depth"].astype(np.float32))
        for gap in (1, 3, 5):
            result = align(image(k), image(k + gap), rho[None], camera)
            found.append(errors_of(result, (lie.se3_inverse(truth[k + gap]) @ truth[k])[None]))
    errors = joined(found)
    good = (errors.deg < 0.03) & (errors.metres < 0.003)
    assert len(good) == 30
    assert good.double().mean() >= 0.9, summary(errors)
    assert not (errors.converged & ~good).any(), summary(errors)


@pytest.mark.slow
def test_a_thousand_random_pairs_are_aligned():
    # At 512 x 256 the 0.05 deg are a fourteenth of a pixel. At 256 x 128 they would be a 28th, below what two
    # aliased images determine: there 2 to 8 % of the pairs miss it although they converged to where they should.
    found = []
    for part in range(32):
        count = 32 if part < 31 else 8
        pairs = sample_pairs(
            count, seed=100 + part, width=512, height=256, world=WORLDS[part % len(WORLDS)], gray=True,
            max_rotation_deg=4.0, max_translation_m=0.07, affine=True,
        )  # fmt: skip
        result = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera)
        errors = errors_of(result, pairs.T_tgt_ref_true)
        known = pairs.rho > 0
        mean_range = torch.where(known, 1 / pairs.rho, 0.0).sum((1, 2)) / known.sum((1, 2))
        found.append(errors._replace(metres=errors.metres / mean_range))
    errors = joined(found)  # translations as shares of the mean range
    good = (errors.deg < 0.05) & (errors.metres < 0.01)
    assert len(good) == 1000
    assert good.double().mean() >= 0.99, summary(errors)
    assert not (errors.converged & ~good).any(), summary(errors)
