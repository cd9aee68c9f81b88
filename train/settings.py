"""The settings of a training: Hydra composes conf/train upon its dataclass, and its complaints become sentences."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from torchvo360.checks import InputError
from torchvo360.cli import overrides as overrides_of
from torchvo360.cli.overrides import to_yaml
from torchvo360.files import write_atomically
from torchvo360.learn import TrainerConfig
from torchvo360.learn.plugin import TARGET

SETTINGS = "config.yaml"
"""The settings of a training in its folder, which `resume=true` starts from."""

OF_THE_CALL = {"out", "resume", "overwrite"}
"""Keys that say what a call does, and nothing about the training."""

LITERAL = ("out", "start")
"""Keys whose value is taken as it stands: brackets, commas and equal signs are common in names of files."""


@dataclass(kw_only=True)
class TrainingConfig:
    """Settings that all trainings have; a training's own dataclass extends it."""

    out: str | None = None
    """Folder of the results; null for runs/train/<name>/<date_time>."""
    resume: bool = False
    """Continue the training that `out` holds, with its settings and those that are given anew."""
    overwrite: bool = False
    """Replace the training that `out` holds."""
    threads: int | None = 1
    """Threads to compute with; null leaves it to PyTorch and OpenCV."""
    trainer: TrainerConfig = field(default_factory=TrainerConfig)

    def __post_init__(self) -> None:
        if self.out == "":
            raise InputError("out: expected a folder, got an empty name.")
        if self.threads is not None and self.threads < 1:
            raise InputError(f"threads: expected at least 1, got {self.threads}.")
        if self.resume and self.overwrite:
            raise InputError("overwrite: expected false where resume=true, got true.")


def compose(name: str, schema: type[TrainingConfig], overrides: Sequence[str], conf: Path) -> Any:
    """Return the settings that overrides make of the defaults, or of those of the training that is to be resumed.

    Args:
        name: Of the configuration conf/train/NAME.yaml.
        schema: Its dataclass, with the keys `out` and `resume`.
        overrides: As on the command line, `key=value`.
        conf: The folder of the configuration.

    Raises:
        InputError: A key or a value is not one of ours, or there is no training to resume.
    """
    overrides = [overrides_of.literal(text) if text.partition("=")[0] in LITERAL else text for text in overrides]
    check_keys(schema, overrides)
    with hydra_ready(schema, conf):
        config = composed(name, hydra.compose, overrides)
    try:
        if config.resume:
            config = _resumed(schema, config, overrides)
    except OmegaConfBaseException as error:
        complaint = str(error).partition("\n")[0]
        raise InputError(f"settings: expected values that fit their keys, got: {complaint}.") from None
    return overrides_of.resolved(config)


def write_settings(folder: Path, config: object, command: str) -> None:
    """Write the settings of a training into its folder, and the command that makes it again on top of them."""
    write_atomically(folder / SETTINGS, f"# {' '.join(command.split())}\n{to_yaml(config)}")


def command_of(out: str) -> str:
    """Return the command on top of the settings in a training's folder."""
    first_line = (Path(out).expanduser() / SETTINGS).read_text(encoding="utf-8").partition("\n")[0]
    return first_line.removeprefix("# ")


def composed(name: str, function: Callable[..., Any], overrides: Sequence[str], **options: Any) -> Any:
    """Call one of Hydra's functions with the configuration conf/train/NAME.yaml.

    Raises:
        InputError: Hydra refused the overrides.
    """

    try:
        return overrides_of.explained(function, name, overrides, **options)
    except InputError as error:
        if absent := re.match(r"hydra/launcher: .*, got ([a-z]+)", str(error)):
            brings = f"which pip install hydra-{absent[1]}-launcher brings"
            raise InputError(f"cluster: expected the launcher {absent[1]}, {brings}, got none.") from None
        raise


def hydra_ready(schema: type, conf: Path) -> AbstractContextManager[None]:
    """Return Hydra made ready for a training's configuration."""
    return overrides_of.hydra_ready(schema, conf, "train")


def check_keys(schema: type, overrides: Sequence[str]) -> None:
    """Refuse overrides that Hydra cannot read, and keys that a training does not have.

    Raises:
        InputError: There is such a one.
    """
    overrides_of.check_keys(overrides, schema, ["cluster"], example="trainer.steps=1000", printed_by="-c")


def _resumed(schema: type, config: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return the settings of the training in `out`, and over them those that the overrides name."""
    if config.out is None:
        raise InputError("out: expected the folder of the training to resume, got null.")
    path = Path(config.out).expanduser() / SETTINGS
    try:
        before = OmegaConf.load(path)
    except OSError:
        raise InputError(f"out: expected a folder with a training to resume, got {config.out}.") from None
    except (YAMLError, UnicodeDecodeError):
        raise InputError(f"out: expected settings in {path}, got a damaged file.") from None
    if not isinstance(before, DictConfig):
        raise InputError(f"out: expected settings in {path}, got a damaged file.")
    kept = {key: value for key, value in before.items() if key not in OF_THE_CALL}
    merged = OmegaConf.merge(OmegaConf.structured(schema), kept)
    assert isinstance(merged, DictConfig)
    given = {text.partition("=")[0].lstrip("+") for text in overrides}
    for key in sorted(given):
        if not key.startswith(("hydra", "cluster")):
            OmegaConf.update(merged, key, OmegaConf.select(config, key))
    for key, name in _named_classes(merged):
        if key not in given and not name.startswith("torchvo360.learn."):
            expected = "to be given again, as a folder's settings are not trusted to name a class"
            raise InputError(f"{key}: expected {expected}, got {name} from {path}.")
    return merged


def _named_classes(node: DictConfig, path: str = "") -> Iterator[tuple[str, str]]:
    for key, child in node.items():
        if key == TARGET and child is not None:
            yield f"{path}{key}", str(child)
        elif isinstance(child, DictConfig):
            yield from _named_classes(child, f"{path}{key}.")
