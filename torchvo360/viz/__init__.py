"""Pictures of results; they need the extra `viz`."""

from torchvo360.viz.plots import plot_trajectory

__all__ = ["plot_trajectory"]
