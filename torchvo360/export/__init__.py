"""Results as files in other programs' formats; a file appears under its name only when it is complete."""

from torchvo360.export.atomic import atomic_path
from torchvo360.export.ply import write_ply
from torchvo360.export.tum import write_tum

__all__ = ["atomic_path", "write_ply", "write_tum"]
