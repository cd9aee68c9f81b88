"""The experiments of train/depth.py: range learned from true ranges, and from neighbouring views alone."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchvo360 import AlignConfig, align
from torchvo360.cameras import Equirectangular
from torchvo360.checks import check_finite_number
from torchvo360.learn import TrainerConfig
from torchvo360.learn.depth import PanoramaDepth
from torchvo360.learn.range_losses import dissimilarity, laplace_loss, log_error, roughness, sphere_mean, warped
from views import AppearanceConfig, Views, repainted, turned
from worlds import ViewsConfig

AT_ONCE = 8
"""Views that a validation passes through the network together."""
SURE = 0.05
"""Relative variance below which the odometry tracks a point (`MapConfig`)."""
SHADES = math.log(10.0)
"""A picture of log rho goes from black to white over this on either side of 3 m."""
FROM_LOG = 1.1


@dataclass(kw_only=True)
class NeighboursConfig:
    """Settings of learning without true ranges."""

    backward: str = "implicit"
    """How gradients pass through the poses that `align` finds: implicit, unroll, truncated or none."""
    smoothness: float = 0.02
    """Weight of range edges where the image has none."""
    likelihood: float = 0.02
    """Weight of what the range's variance is learned from: the differences of intensity that it explains."""
    noise: float = 0.004
    """Difference of intensity that remains at the right range."""
    anchor: float = 0.01
    """Weight that holds each view's mean of log rho, as neighbours fix ranges but for a common factor."""
    range_m: float = 3.0
    """The range it is held to, metres."""

    def __post_init__(self) -> None:
        for name in ("range_m", "noise"):
            check_finite_number(name, getattr(self, name), above=0.0)
        for name in ("smoothness", "likelihood", "anchor"):
            check_finite_number(name, getattr(self, name), above=-1e-9)


def _distribution(
    module: nn.Module, image: Float[Tensor, "B K 3 H W"]
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Return log rho of each element's first view, and the logarithm of its scale."""
    assert isinstance(module, PanoramaDepth)
    return module.distribution(image[:, 0])


class Ranges:
    """What both experiments share: batches, validation and pictures."""

    neighbours = False
    """Whether views come with their neighbours."""

    def __init__(
        self,
        module: PanoramaDepth,
        trainer: TrainerConfig,
        views: ViewsConfig,
        held_back: ViewsConfig,
        appearance: AppearanceConfig,
    ) -> None:
        self.module: nn.Module = module
        self.trainer, self.appearance = trainer, appearance
        arguments = {"width": module.width, "channels": module.channels}
        self.spec: dict[str, Any] = {"_target_": "torchvo360.learn.depth.PanoramaDepth", **arguments}
        self.camera = Equirectangular(module.width, module.width // 2)
        self.views = Views(views, self.camera, neighbours=self.neighbours)
        self.held_back = Views(held_back, self.camera, neighbours=self.neighbours)

    def batch(self, step: int, part: int, parts: int) -> tuple[Tensor, Tensor]:
        """Draw views, turn, mirror and repaint them; return images [B, K, 3, H, W] and true rho [B, H, W]."""
        seed, size = self.trainer.seed * 1_000_003 + step, self.trainer.batch_size
        generator = torch.Generator().manual_seed(seed)
        index = torch.randint(len(self.views), (size,), generator=generator)
        shift = torch.randint(self.camera.width, (size,), generator=generator)
        mirrored = torch.rand(size, generator=generator) < 0.5
        chosen = turned(self.views.take(index.tolist()), shift, mirrored)
        paint = torch.Generator().manual_seed(seed * 1024)
        image = repainted(chosen.image, self.appearance, paint)
        # All of the batch is drawn by every process: then the joint batch does not depend on their number.
        share = self.trainer.share(part, parts)
        mine = slice(share.start, share.stop)
        return image[mine], chosen.rho[mine]

    def losses(self, module: nn.Module, batch: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return what is minimised as `loss`, and its parts."""
        raise NotImplementedError

    def validate(self, module: nn.Module) -> dict[str, float]:
        """Return figures on the held-back views.

        They are means over views of: `log_error`, the mean error of log rho; `shape_error`, its deviation within a
        view, which a common factor does not change; `surprise`, the mean of that in units of the predicted scale, 1 if
        the scale is right; `sure`, the share of relative variances below 0.05; and `scale` and `scale_worst`, the
        median and the largest over views of how far the median ratio of predicted and true rho is from 1.
        """
        rows = []
        for first in range(0, len(self.held_back), AT_ONCE):
            image, rho_true = self._held(range(first, min(first + AT_ONCE, len(self.held_back))), module)
            rows.append(self.figures(image, rho_true, *_distribution(module, image)))
        table = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
        away = (table.pop("ratio") - 1).abs()
        figures = {name: float(values.mean()) for name, values in table.items()}
        return {**figures, "scale": float(away.median()), "scale_worst": float(away.max())}

    def figures(self, image: Tensor, rho_true: Tensor, log_rho: Tensor, log_scale: Tensor) -> dict[str, Tensor]:
        """Return the figures of each view."""
        error, known = log_error(log_rho, rho_true)
        within = error - sphere_mean(error, self.camera, known)[:, None, None]
        return {
            "log_error": sphere_mean(error.abs(), self.camera, known),
            "shape_error": sphere_mean(within.square(), self.camera, known).sqrt(),
            "surprise": sphere_mean(within.abs() * (-log_scale).exp(), self.camera, known),
            "sure": sphere_mean((2 * (2 * log_scale).exp() < SURE).to(error.dtype), self.camera, known),
            "ratio": torch.where(known, error, torch.nan).flatten(1).nanmedian(1).values.exp(),
        }

    def pictures(self, module: nn.Module) -> dict[str, Float[Tensor, "3 H W"]]:
        """Return a view of each kind above its predicted and true inverse range and the predicted deviation."""
        out = {}
        for kind, number in self.held_back.first_of_kinds().items():
            image, rho_true = self._held(range(number, number + 1), module)
            log_rho, log_scale = _distribution(module, image)
            shades = [((part + FROM_LOG) / SHADES + 1) / 2 for part in (log_rho, rho_true.clamp_min(1e-6).log())]
            rows = [image[0, 0], *(part.expand(3, -1, -1) for part in (*shades, log_scale.exp()))]
            out[kind] = torch.cat([row.clamp(0, 1) for row in rows], 1)
        return out

    def _held(self, index: range, module: nn.Module) -> tuple[Tensor, Tensor]:
        device = next(module.parameters()).device
        batch = self.held_back.take(list(index))
        return batch.image.to(device), batch.rho.to(device)


class TrueRanges(Ranges):
    """Learning by true ranges: the likelihood of log rho, and each view's common error, which is that of its scale."""

    def __init__(self, *args: Any, common_error: float) -> None:
        super().__init__(*args)
        self._common_error = common_error

    def losses(self, module: nn.Module, batch: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        image, rho_true = batch
        log_rho, log_scale = _distribution(module, image)
        error, known = log_error(log_rho, rho_true)
        likelihood = laplace_loss(error, log_scale, self.camera).mean()
        common = sphere_mean(error, self.camera, known).abs().mean()
        return {"loss": likelihood + self._common_error * common, "likelihood": likelihood, "common": common}


class Neighbours(Ranges):
    """Learning without true ranges: neighbours, seen through a view's ranges from `align`'s poses, look like it.

    The poses come from the layer with the same ranges, so that the two agree but for a common factor. True ranges enter
    nothing but the validation's figures; the one to watch is `photometric`, which needs none.
    """

    neighbours = True

    def __init__(self, *args: Any, config: NeighboursConfig) -> None:
        super().__init__(*args)
        self._config = config
        # Ranges are wrong at first, and so is what agrees: a pose is as good as it gets for them.
        self._align = AlignConfig(
            affine=False,
            coarsest_width=self.camera.width // 4,
            finest=1,
            min_agreement=0.0,
            steps_by_level=[10],
            backward=config.backward,
        )

    def losses(self, module: nn.Module, batch: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        image, _ = batch
        log_rho, log_scale = _distribution(module, image)
        unlike, likelihood, converged = self._seen_from_neighbours(image, log_rho, log_scale)
        parts = {
            "photometric": unlike.mean(),
            "smoothness": roughness(log_rho, image[:, 0], self.camera).mean(),
            "likelihood": likelihood.mean(),
            "anchor": (sphere_mean(log_rho, self.camera) + math.log(self._config.range_m)).square().mean(),
        }
        priced = [getattr(self._config, name) * part for name, part in parts.items() if name != "photometric"]
        return {"loss": parts["photometric"] + torch.stack(priced).sum(), **parts, "converged": converged}

    def figures(self, image: Tensor, rho_true: Tensor, log_rho: Tensor, log_scale: Tensor) -> dict[str, Tensor]:
        unlike, _, _ = self._seen_from_neighbours(image, log_rho, log_scale)
        return {**super().figures(image, rho_true, log_rho, log_scale), "photometric": unlike}

    def _seen_from_neighbours(
        self, image: Tensor, log_rho: Tensor, log_scale: Tensor
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"], Float[Tensor, ""]]:
        """Return how unlike each view its neighbours look, the likelihood of the rest, and the share of good poses."""
        count, camera = image.shape[1] - 1, self.camera
        ref, tgt = image[:, :1].expand(-1, count, -1, -1, -1), image[:, 1:]
        rho = log_rho.float().exp()[:, None].expand(-1, count, -1, -1)  # autocast may have halved it
        found = align(ref.mean(2, keepdim=True), tgt.mean(2, keepdim=True), rho, camera, config=self._align)
        view, neighbour, rho, T_tgt_ref = (part.flatten(0, 1) for part in (ref, tgt, rho, found.T_tgt_ref))
        seen = warped(neighbour, rho, T_tgt_ref, camera)
        # What one neighbour cannot see, the other may (Godard et al., 2019).
        unlike, best = dissimilarity(view, seen, camera).unflatten(0, (-1, count)).min(1)

        def of_best(value: Tensor) -> Tensor:
            return value.mean(1).abs().unflatten(0, (-1, count)).gather(1, best[:, None])[:, 0].detach()

        # To first order a range that errs by a share s changes the intensity by s times its slope by log rho.
        slope = of_best((warped(neighbour, rho * 1.05, T_tgt_ref, camera) - seen) / math.log(1.05))
        deviation = self._config.noise + slope * log_scale.exp()
        likelihood = sphere_mean(of_best(view - seen) / deviation + deviation.log(), camera)
        return sphere_mean(unlike, camera), likelihood, (found.status == 0).to(log_rho.dtype).mean()
