"""One training in one process or in several, which Lightning Fabric joins when torchrun has started them."""

import atexit
import gc
import os
import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchvo360.checks import InputError
from torchvo360.learn.schedule import TrainerConfig

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def join(config: TrainerConfig) -> "Fabric":
    """Join the processes that torchrun started, or be the only one; they part when the interpreter ends.

    Raises:
        InputError: Lightning Fabric is not installed, there is no such device, or the batch has no equal shares.
    """
    try:
        from lightning_fabric import Fabric
    except ModuleNotFoundError:
        raise InputError("train: expected lightning-fabric, which pip install 'torchvo360[train]' brings.") from None
    if config.device == "cuda" and not torch.cuda.is_available():
        raise InputError("device: expected cpu, as PyTorch finds no CUDA device here, got cuda.")
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    here = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if config.batch_size % processes:
        raise InputError(f"batch_size: expected a multiple of {processes} processes, got {config.batch_size}.")
    fabric = Fabric(
        accelerator=config.device,
        devices=here,
        num_nodes=processes // here,
        strategy=config.strategy,
        precision=config.precision,  # pyright: ignore[reportArgumentType]
    )
    alone = not _are_joined()
    fabric.launch()
    if alone and _are_joined():
        atexit.register(_part)  # a group that torchrun brought together can be made only once
    return fabric


def _are_joined() -> bool:
    return torch.distributed.is_available() and torch.distributed.is_initialized()


def _part() -> None:
    """Tear down the group of processes, when nothing else holds it any more.

    If a wrapped module held the last reference, the group would be torn down with the interpreter locked, while Gloo's
    threads wait for that lock: a deadlock (pytorch/pytorch#56297, open).
    """
    gc.collect()
    if _are_joined():
        torch.distributed.destroy_process_group()


@contextmanager
def own_random_numbers() -> Iterator[None]:
    """Give back the states of the global random generators as they were."""
    python, numpy = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng():
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)


def seed_random_numbers(*numbers: int) -> None:
    """Set the global random generators, which dropout draws from, by numbers such as seed, step and process.

    So a step's random numbers depend on nothing that came before it, and a resumed training needs no saved generators.
    """
    seed = int(np.random.SeedSequence(numbers).generate_state(1)[0])
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def reduced(fabric: "Fabric", values: Sequence[float | Tensor], how: str) -> list[float]:
    """Return the mean or the sum of each number over the processes: the same in all of them.

    Args:
        fabric: What joins the processes.
        values: Numbers or scalar tensors, as many in every process.
        how: mean or sum.
    """
    numbers = torch.stack([torch.as_tensor(v, dtype=torch.float64, device=fabric.device).detach() for v in values])
    total = fabric.all_reduce(numbers, reduce_op=how)
    assert isinstance(total, Tensor)
    return total.tolist()
