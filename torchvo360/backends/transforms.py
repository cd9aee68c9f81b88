"""Whether tensors are plain numbers at the moment, or stand for what is being transformed."""

import torch
from torch.autograd import forward_ad


def in_transform() -> bool:
    """Return whether tensors may be no plain numbers: compiled, mapped, or differentiated forwards."""
    return (
        torch.compiler.is_compiling()
        or torch._C._functorch.peek_interpreter_stack() is not None  # pyright: ignore[reportAttributeAccessIssue]
        or forward_ad._current_level >= 0
    )
