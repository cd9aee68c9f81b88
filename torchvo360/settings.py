"""The settings of one run, each with its default and what it means."""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchvo360.checks import InputError, check_choice
from torchvo360.data.synthetic import SyntheticConfig
from torchvo360.vo import OdometryConfig

SYNTHETIC = "synthetic"
"""The input that is rendered, with the settings `synthetic`."""

SHIPPED = "shipped"
"""The depth network that comes with the package."""

CLIPS = Path(__file__).parent / "data" / "clips"

MAX_SEED = 2**63 - 1


@dataclass(kw_only=True)
class CameraConfig:
    """How the images of a file become those of a camera."""

    fit: str = "none"
    """What happens to images that are not 2:1: none refuses them, stretch resamples rows, crop cuts rows off."""

    def __post_init__(self) -> None:
        check_choice("fit", self.fit, ("none", "stretch", "crop"))


@dataclass(kw_only=True)
class DepthConfig:
    """The network that gives inverse ranges in metres, from which the odometry begins at once; none by default."""

    checkpoint: str | None = None
    """Its file, NAME.safetensors with NAME.json beside it; `shipped` for the package's own."""
    _target_: str | None = None
    """The dotted name of a class of one's own that fulfils `DepthEstimator`: in place of `shipped`, or for the tensors
    of the checkpoint."""
    arguments: Any = None
    """Arguments of that class, such as {width: 128}, where no checkpoint holds them."""

    def __post_init__(self) -> None:
        if self.checkpoint == "":
            raise InputError("checkpoint: expected a file, got an empty name.")
        if self.arguments is None:
            return
        if not isinstance(self.arguments, dict):
            raise InputError(f"arguments: expected a mapping such as {{width: 128}}, got {self.arguments!r}.")
        if self._target_ is None or self.checkpoint not in (None, SHIPPED):
            raise InputError(f"arguments: expected none but for a _target_ without a checkpoint, got {self.arguments}.")


@dataclass(kw_only=True)
class RunConfig:
    """Settings of one run; conf/config.yaml composes them."""

    input: str = "theta_walk"
    """A video, a folder of images, a glob pattern, `synthetic`, or the name of an embedded clip."""
    mask: Any = None
    """Pixels not to use: an image (white = use), `below:LAT`, `above:LAT`, `box:LON0:LAT0:LON1:LAT1`, or a list."""
    resize: str | None = "auto"
    """WIDTHxHEIGHT to resample to; auto brings wider input down to 1024x512; null keeps the input's size."""
    camera: CameraConfig = field(default_factory=CameraConfig)
    start: int = 0
    """First frame to use."""
    stop: int | None = None
    """Frame before which to stop; null for the end."""
    every: int = 1
    """Use one frame out of this many."""
    fps: float | None = None
    """Frame rate: replaces a video's own time stamps; 30 for images where it is null."""
    truth: str | None = None
    """A TUM file with true poses at the frames' times, in seconds."""
    seed: int = 0
    """Of the odometry's random samples."""
    threads: int | None = 1
    """Threads to compute with: small operations gain little from more; null leaves it to PyTorch and OpenCV."""
    device: str = "cpu"
    """cpu or cuda."""
    out: str | None = None
    """Folder of the results; null for runs/<input>/<date_time>."""
    overwrite: bool = False
    """Replace the run that `out` holds."""
    plot: str = "auto"
    """Draw trajectory.png: auto draws it where matplotlib is installed."""
    progress: bool = True
    """Show a progress bar where standard error is a terminal."""
    synthetic: SyntheticConfig = field(default_factory=SyntheticConfig)
    vo: OdometryConfig = field(default_factory=OdometryConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)

    def __post_init__(self) -> None:
        self.plot = str(self.plot).lower()  # true and false are no words to YAML
        check_choice("plot", self.plot, ("auto", "true", "false"))
        check_choice("device", self.device, ("cpu", "cuda"))
        if not self.input:
            raise InputError("input: expected a video, a folder of images or a glob pattern, got an empty name.")
        if self.out == "":
            raise InputError("out: expected a folder, got an empty name.")
        if self.truth == "":
            raise InputError("truth: expected a TUM file, got an empty name.")
        items = self.mask if isinstance(self.mask, list) else [self.mask]
        if self.mask is not None and not all(isinstance(item, str) and item for item in items):
            raise InputError(f"mask: expected an image file, a sector or a list of them, got {self.mask!r}.")
        if not 0 <= self.seed <= MAX_SEED:
            raise InputError(f"seed: expected 0 to {MAX_SEED}, got {self.seed}.")
        most = 4 * (os.cpu_count() or 1)
        if self.threads is not None and self.threads < 1:
            raise InputError(f"threads: expected at least 1, got {self.threads}.")
        if self.threads is not None and self.threads > most:
            raise InputError(f"threads: expected at most {most} on this machine, got {self.threads}.")
        _ = self.size

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height that `resize` asks for; None for `auto` and where it asks for none.

        Raises:
            InputError: It is something else.
        """
        if self.resize is None or self.resize == "auto":
            return None
        if not (match := re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", self.resize)):
            raise InputError(f"resize: expected WIDTHxHEIGHT such as 1024x512, auto or null, got {self.resize!r}.")
        return int(match[1]), int(match[2])


def embedded_clip(name: str) -> Path | None:
    """Return the file of an embedded clip, None where there is none of that name."""
    path = CLIPS / f"{name}.mp4"
    return path if name.isidentifier() and path.is_file() else None
