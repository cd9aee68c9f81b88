"""From overrides to the settings of a run: Hydra composes conf/ upon the schema RunConfig."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import hydra

from torchvo360.cli import overrides as ours
from torchvo360.settings import RunConfig

PATHS = ("input", "truth", "out", "imu", "camera.calibration", "depth.checkpoint")
"""Keys whose value is taken as it stands: brackets, commas and equal signs are common in names of files."""


def compose(overrides: Sequence[str], conf: Path) -> RunConfig:
    """Return the settings that overrides make of the defaults and of the embedded clip's own settings.

    Args:
        overrides: As on the command line, `key=value`.
        conf: The folder of the configuration.

    Raises:
        InputError: A key or a value is not one of ours.
    """
    overrides = [_literal(override) for override in overrides]
    check_keys(overrides)
    with hydra_ready(conf):
        config = explained(hydra.compose, overrides)
        clips = [path.stem for path in (conf / "clip").glob("*.yaml")]
        if config.input in clips and not any(override.startswith("clip=") for override in overrides):
            config = explained(hydra.compose, [f"clip={config.input}", *overrides])
    return ours.resolved(config)


def hydra_ready(conf: Path) -> AbstractContextManager[None]:
    """Return Hydra made ready for a run's configuration."""
    return ours.hydra_ready(RunConfig, conf, "torchvo360")


def check_keys(overrides: Sequence[str]) -> None:
    """Refuse overrides that Hydra cannot read, and keys that a run does not have.

    Raises:
        InputError: There is such a one.
    """
    ours.check_keys(overrides, RunConfig, ["clip"], example="input=walk.mp4", printed_by="torchvo360 --cfg")


def explained(function: Callable[..., Any], overrides: Sequence[str], **options: Any) -> Any:
    """Call one of Hydra's functions with a run's configuration, and turn its complaint into a sentence.

    Raises:
        InputError: Hydra refused the overrides.
    """
    return ours.explained(function, "config", overrides, **options)


def _literal(override: str) -> str:
    key, _, value = override.partition("=")
    return ours.literal(override) if key in PATHS or (key == "mask" and Path(value).is_file()) else override
