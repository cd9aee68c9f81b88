"""A ray-cast world to test in: textured rooms with exact poses and ranges, for every central camera."""

from torchvo360.data.synthetic.layouts import WORLDS, make_world
from torchvo360.data.synthetic.pairs import Pairs, sample_pairs
from torchvo360.data.synthetic.sequence import SyntheticConfig, SyntheticSequence
from torchvo360.data.synthetic.world import World

__all__ = ["WORLDS", "Pairs", "SyntheticConfig", "SyntheticSequence", "World", "make_world", "sample_pairs"]
