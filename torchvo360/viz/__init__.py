"""Results to look at: pictures, which need the extra `viz`, a page for the browser, and the Rerun viewer."""

from torchvo360.viz.errors import plot_errors
from torchvo360.viz.plots import plot_trajectory

__all__ = ["plot_errors", "plot_trajectory"]
