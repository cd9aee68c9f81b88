"""Results as files in other programs' formats."""

from torchvo360.export.ply import write_ply
from torchvo360.export.tum import write_tum

__all__ = ["write_ply", "write_tum"]
