"""The page of a run: one file that shows all of it in a browser, without a network."""

from torchvo360.viz.report.content import Content
from torchvo360.viz.report.page import write_report
from torchvo360.viz.report.pictures import Picture, Pictures

__all__ = ["Content", "Picture", "Pictures", "write_report"]
