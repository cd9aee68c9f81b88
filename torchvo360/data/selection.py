"""Which frames of a source are used: `start:stop:every`."""

from dataclasses import dataclass

from torchvo360.checks import InputError


@dataclass(frozen=True)
class Selection:
    """The frames from `start` to before `stop` (None for the end), one out of `every`.

    Raises:
        InputError: They are out of range or in the wrong order.
    """

    start: int = 0
    stop: int | None = None
    every: int = 1

    def __post_init__(self) -> None:
        if self.start < 0:
            raise InputError(f"start: expected at least 0, got {self.start}.")
        if self.stop is not None and self.stop <= self.start:
            raise InputError(f"stop: expected more than start ({self.start}), got {self.stop}.")
        if self.every < 1:
            raise InputError(f"every: expected at least 1, got {self.every}.")

    def of(self, length: int) -> range:
        """Return the selected indices of a source with this many frames.

        Raises:
            InputError: Fewer than two are left.
        """
        if self.start >= length > 1:
            raise InputError(f"start: expected less than the {length} frames of the input, got {self.start}.")
        selected = range(length)[self.start : self.stop : self.every]
        if len(selected) < 2:
            chosen = "" if self == Selection() else " after start, stop and every"
            raise InputError(f"input: expected at least two frames{chosen}, got {len(selected)}.")
        return selected
