"""The command `torchvo360`: the only room that knows Hydra."""

from torchvo360.cli.command import main

__all__ = ["main"]
