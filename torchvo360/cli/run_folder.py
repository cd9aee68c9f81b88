"""What the folder of a run tells of its input."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from torchvo360.checks import InputError
from torchvo360.cli.overrides import resolved
from torchvo360.data import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.opening import open_input
from torchvo360.settings import RunConfig

SETTINGS, TRUTH = "config.yaml", "truth.txt"


def read_settings(folder: str | Path) -> RunConfig:
    """Return the settings of the run in a folder.

    Raises:
        InputError: They are missing, damaged or another program's.
    """
    path = Path(folder).expanduser() / SETTINGS
    try:
        written = OmegaConf.load(path)
        if not isinstance(written, DictConfig):
            raise InputError(f"{path}: expected the settings of a run, got something else.")
        return resolved(OmegaConf.merge(OmegaConf.structured(RunConfig), written))  # pyright: ignore[reportArgumentType]
    except OSError as error:
        raise InputError(f"{path}: expected the settings of a run, got {error.strerror or error}.") from None
    except (YAMLError, UnicodeDecodeError):
        raise InputError(f"{path}: expected the settings of a run, got a damaged file.") from None
    except OmegaConfBaseException as error:
        complaint = str(error).partition("\n")[0]
        raise InputError(f"{path}: expected the settings of a run, got others: {complaint}.") from None


def truth_of(folder: str | Path) -> Trajectory | None:
    """Return the true poses of the run in a folder: from truth.txt in it, or else from its input, opened again.

    None where the input has none.

    Raises:
        InputError: The settings or the input cannot be read; paths are those of the run's working directory.
    """
    own = Path(folder).expanduser() / TRUTH
    if own.is_file():
        return read_tum(own)
    config = read_settings(folder)
    try:
        return open_input(config).sequence.truth if config.truth is None else read_tum(config.truth)
    except InputError as error:
        raise InputError(f"{folder}, {SETTINGS}: {error}") from None
