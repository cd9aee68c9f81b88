"""What is learned: the contract between an experiment and its trainer."""

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchvo360.checks import InputError
from torchvo360.learn.plugin import NonFiniteError


class Experiment(Protocol):
    """What is learned, from what, and how well; `train` does the rest.

    Batches are moved to the device of the module; whatever else it holds stays where it is.
    """

    module: nn.Module
    """The network; the trainer moves it to its device."""
    spec: dict[str, Any]
    """`_target_`, the dotted name of its class, and the arguments that make it again: they go into its checkpoints."""

    def batch(self, step: int, part: int, parts: int) -> Any:
        """Return the share of a step's batch that falls to process `part` of `parts` (`TrainerConfig.share`).

        A pure function of the experiment's seed and the step, counted from 0, so that a resumed training sees the same.
        Tensors, in dicts, lists and tuples of any depth.
        """
        ...

    def losses(self, module: nn.Module, batch: Any) -> dict[str, Tensor]:
        """Return named scalars of a batch: `loss`, a mean over its elements, is minimised; the others are shown.

        Where it raises `NonFiniteError`, as `checked_features` and `checked_ranges` do, the step is skipped.
        """
        ...

    def validate(self, module: nn.Module) -> dict[str, float]:
        """Return figures on data never trained on; without gradients, in evaluation mode, in the first process only."""
        ...

    def pictures(self, module: nn.Module) -> dict[str, Float[Tensor, "3 H W"]]:
        """Return pictures in [0, 1] for TensorBoard; called as `validate` is."""
        ...


class Share:
    """One process's share of a batch, out of sight: Fabric would bring the floats in a network's arguments to half."""

    def __init__(self, batch: Any) -> None:
        self.batch = batch


class Objective(nn.Module):
    """The experiment's losses as one forward pass, which is what averages gradients over processes."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__()
        self.module = experiment.module
        self._losses = experiment.losses

    def forward(self, share: Share, names: Sequence[str]) -> dict[str, Tensor]:
        """Return the losses of one process's share of a batch, all NaN where the network gave no finite numbers.

        Args:
            share: Of the batch.
            names: Those of the losses of the steps before, none before the first.

        Raises:
            InputError: They are not named scalars with a `loss` to minimise among them, or the first are not finite.
        """
        try:
            losses = self._losses(self.module, share.batch)
        except NonFiniteError:
            if not names:  # the network was never fine
                raise
            return self._not_finite(names)
        _check(losses)
        return losses

    def _not_finite(self, names: Sequence[str]) -> dict[str, Tensor]:
        """Return losses of NaN that depend on every parameter.

        So all gradients are NaN, and their mean over processes too: none is left waiting, and all skip the step.
        """
        learned = [parameter.sum() for parameter in self.module.parameters() if parameter.requires_grad]
        nothing = torch.stack(learned).sum() * math.nan
        return {name: nothing if name == "loss" else nothing.detach() for name in names}


def _check(losses: dict[str, Tensor]) -> None:
    if "loss" not in losses or not losses["loss"].requires_grad:
        got = ", ".join(losses) or "nothing"
        raise InputError(f"losses: expected loss, with a gradient to the module's parameters, got {got}.")
    for name, value in losses.items():
        if value.ndim:
            raise InputError(f"losses: expected scalars, got {name} of shape {list(value.shape)}.")
