"""Results as files in other programs' formats."""

from torchvo360.export.ply import read_ply, write_ply
from torchvo360.export.tum import write_tum

__all__ = ["read_ply", "write_ply", "write_tum"]
