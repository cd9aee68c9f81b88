"""Learning with the alignment layer: what a network must fulfil, how it is trained, and how it is kept as a file."""

from torchvo360.learn.checkpoint import load_checkpoint, save_checkpoint
from torchvo360.learn.experiment import Experiment
from torchvo360.learn.plugin import (
    DepthEstimator,
    FeatureExtractor,
    FeaturePyramid,
    NonFiniteError,
    RangeEstimate,
    build,
    checked_features,
    checked_ranges,
)
from torchvo360.learn.schedule import TrainerConfig
from torchvo360.learn.trainer import Ending, TrainOutcome, train

__all__ = [
    "DepthEstimator",
    "Ending",
    "Experiment",
    "FeatureExtractor",
    "FeaturePyramid",
    "NonFiniteError",
    "RangeEstimate",
    "TrainOutcome",
    "TrainerConfig",
    "build",
    "checked_features",
    "checked_ranges",
    "load_checkpoint",
    "save_checkpoint",
    "train",
]
