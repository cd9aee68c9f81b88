"""How a solve ended: a value for each element of a batch, never an exception."""

from enum import IntEnum


class Status(IntEnum):
    """The outcome of one alignment."""

    CONVERGED = 0
    MAX_STEPS = 1
    STALLED = 2
    SINGULAR = 3
    TOO_FEW_PIXELS = 4
    DIVERGED = 5
    BAD_START = 6

    @property
    def sentence(self) -> str:
        """What the outcome means, for a user."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.CONVERGED: "The alignment converged and the images agree at its end.",
    Status.MAX_STEPS: "The step limit was reached before the steps became small.",
    Status.STALLED: "No step lowered the cost any more although its gradient had not vanished.",
    Status.SINGULAR: "The pixels do not determine all parameters, for instance for want of texture.",
    Status.TOO_FEW_PIXELS: "Too few pixels are known, finite, unmasked and in view.",
    Status.DIVERGED: "The images do not agree at the end: a wrong minimum, or a cost that is not finite.",
    Status.BAD_START: "The start is no rigid motion, not finite or absurdly far away.",
}
