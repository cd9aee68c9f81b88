"""How far an estimated trajectory lies from the true one, and tables of it."""

from torchvo360.evaluation.errors import Evaluation, evaluate
from torchvo360.evaluation.relative import Drift
from torchvo360.evaluation.statistics import Statistics

__all__ = ["Drift", "Evaluation", "Statistics", "evaluate"]
