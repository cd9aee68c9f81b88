"""The settings of `torchvo360-export`."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchvo360.checks import InputError, check_choice
from torchvo360.cli import overrides as ours
from torchvo360.export.cubemap import check_faces
from torchvo360.export.recorded import KEYFRAMES

NAMES = {
    "colmap": "colmap",
    "nerfstudio": "nerfstudio",
    "tum": "trajectory_tum.txt",
    "kitti": "trajectory_kitti.txt",
    "euroc": "trajectory_euroc.csv",
    "frusta": "cameras.glb",
    "ply": "points.ply",
}
"""What each format is called by default, in the run's folder."""

DATA_SETS = ("colmap", "nerfstudio")
"""Formats that are folders with images."""


@dataclass(kw_only=True)
class ExportConfig:
    """Settings of one export."""

    run: str | None = None
    """Folder of a run; null makes one of `input`."""
    format: str = "colmap"
    """colmap, nerfstudio, tum, kitti, euroc, frusta or ply."""
    out: str | None = None
    """The folder or file to write; null for one in the run's folder."""
    overwrite: bool = False
    """Replace an earlier export."""
    input: str | None = None
    """Where the run's input is now; without `run`, what to make a run of."""
    frames: str = KEYFRAMES
    """keyframes, or every so many of all frames."""
    faces: int = 6
    """Pinhole images of a panorama: 6, or 4 without zenith and nadir."""
    fov: float = 90.0
    """Angle across each, degrees, 90 to 120."""
    size: int | None = None
    """Width and height of each, pixels, 8 to 8192; null keeps the panorama's resolution."""
    image: str = "jpg"
    """Kind of image files, jpg or png."""
    progress: bool = True
    """Show a progress bar where standard error is a terminal."""

    def __post_init__(self) -> None:
        check_choice("format", self.format, list(NAMES))
        check_choice("image", self.image, ("jpg", "png"))
        if self.run is None and self.input is None:
            raise InputError("run: expected the folder of a run, or input=PATH to make one, got neither.")
        if self.frames != KEYFRAMES and not (self.frames.isdecimal() and int(self.frames) > 0):
            raise InputError(f"frames: expected keyframes or a number such as 10, got {self.frames}.")
        check_faces(self.faces, self.fov, self.size)
        if self.out == "":
            raise InputError("out: expected a name, got an empty one.")
        usual = {field.name: field.default for field in fields(ExportConfig)}
        for names, formats in ((("faces", "fov", "size"), ("colmap",)), (("image",), DATA_SETS)):
            for name in names:
                if self.format not in formats and getattr(self, name) != usual[name]:
                    raise InputError(f"{name}: expected no value for format={self.format}, got {getattr(self, name)}.")
        if self.frames != KEYFRAMES and self.format not in (*DATA_SETS, "frusta"):
            raise InputError(f"frames: expected no value for format={self.format}, got {self.frames}.")

    @property
    def every(self) -> str | int:
        """Which frames to take: keyframes, or every so many."""
        return self.frames if self.frames == KEYFRAMES else int(self.frames)


def settings_of(overrides: Sequence[str]) -> tuple[ExportConfig, list[str]]:
    """Return the settings of an export, and the overrides that are for the run to be made.

    Raises:
        InputError: One is not key=value, its key is unknown, or its value does not fit.
    """
    own = {field.name for field in fields(ExportConfig)}
    given: dict[str, str | None] = {}
    others: list[str] = []
    for text in overrides:
        key, equal, value = text.partition("=")
        if key in own and equal:
            given[key] = None if value == "null" else value
        else:
            others.append(text)
    if others and (given.get("run") or not given.get("input")):
        ours.check_keys(others, ExportConfig, [], example="run=runs/walk", printed_by="torchvo360-export --help")
    config = OmegaConf.structured(ExportConfig)
    for key, value in given.items():
        try:
            config[key] = value
        except OmegaConfBaseException as error:
            expected = next((words for part, words in ours.TYPE_ERRORS if part in str(error)), "another value")
            raise InputError(f"{key}: expected {expected}, got {value}.") from None
    return ours.resolved(config), others
