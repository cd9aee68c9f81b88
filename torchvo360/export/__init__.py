"""Results as files in other programs' formats."""

from torchvo360.export.euroc import write_euroc
from torchvo360.export.frusta import write_frusta
from torchvo360.export.kitti import write_kitti
from torchvo360.export.ply import read_ply, write_ply
from torchvo360.export.tum import write_tum

__all__ = ["read_ply", "write_euroc", "write_frusta", "write_kitti", "write_ply", "write_tum"]
