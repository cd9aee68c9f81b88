"""The command `torchvo360`: the only file that knows Hydra.

Exit codes: 0 done, 1 a defect of the program (with its traceback), 2 the caller's mistake (with one sentence),
130 and 143 stopped by Ctrl-C and SIGTERM.
"""

import argparse
import difflib
import os
import re
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from torchvo360.checks import InputError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from torchvo360.settings import RunConfig

HELP = """\
torchvo360: the motion of a 360-degree camera from its video.

  torchvo360                                        the embedded clip
  torchvo360 input=walk.mp4                         a video (equirectangular, 2:1)
  torchvo360 input=frames/ fps=15 mask=below:-60    a folder of images, without what is below latitude -60 degrees
  torchvo360 input='frames/*.png' truth=gt.txt      a glob pattern, compared with true poses (TUM file)
  torchvo360 input=synthetic synthetic.world=pillars synthetic.frames=90
  torchvo360 -m input=a.mp4,b.mp4 seed=0,1,2        a sweep: every combination, each into a folder of its own

Settings are key=value:

  input=PATH            video, folder, glob pattern, `synthetic` or the embedded clip `theta_walk` (default)
  mask=MASK             image (white = use), below:LAT, above:LAT, box:LON0:LAT0:LON1:LAT1 (degrees), or [one,another]
  resize=WxH            size to resample to; default: at most 1024x512; null keeps the input's
  camera.fit=HOW        images that are not 2:1: none (refuse, default), stretch or crop
  start= stop= every=   frames to use, counted from 0
  fps=RATE              frame rate of images (default 30), or one that replaces a video's own times
  truth=FILE            TUM file of true poses, for ATE, RPE and coverage
  seed= threads=        random samples; threads to compute with
  device=cpu|cuda
  out=DIR               folder of the results (default runs/<input>/<date_time>); overwrite=true replaces a run there
  plot=auto|true|false  trajectory.png    progress=true|false  progress bar
  synthetic.KEY=VALUE   the rendered input; synthetic=exposure_steps or yaw_jump are presets
  vo.KEY=VALUE          the odometry; vo=clean is a preset for rendered images

Options:

  -m, --multirun        run every combination of values that are separated by commas
  -c, --cfg             print all settings and their values, and do nothing else
  --version             print the version
  -h, --help            print this page

The folder of the results holds trajectory.txt, frames.csv, map.ply, trajectory.png, summary.json and config.yaml.
Ctrl-C ends a run after the frame at hand and keeps what was done.
"""

PATHS = ("input", "truth", "out")
"""Keys whose value is taken as it stands: brackets, commas and equal signs are common in names of files."""

TYPE_ERRORS = (
    (r"converted to Integer", "an integer"),
    (r"converted to Float", "a number"),
    (r"valid bool", "true or false"),
    (r"not Optional", "a value"),
    (r"not a ListConfig|not a list", "a list such as [1,2]"),
    (r"Cannot convert '\w+' to string", "a single value"),
    (r"Invalid type assigned", "its keys one by one, such as camera.fit=stretch"),
)
"""What OmegaConf says of a value that does not fit, and what was expected."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments behind its name and return its exit code."""
    parser = argparse.ArgumentParser("torchvo360", add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-c", "--cfg", action="store_true")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("-h", "--help", action="store_true")
    arguments, unknown = parser.parse_known_args(argv)
    try:
        if arguments.help:
            print(HELP, end="")
            return 0
        if arguments.version:
            print(f"torchvo360 {_version()}")
            return 0
        if unknown:
            raise InputError(f"{unknown[0]}: expected key=value, -m, -c, --version or --help.")
        # Before cv2 is imported: what it says of a damaged file is said by us, in a sentence.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
        return _main(arguments.overrides, arguments.multirun, arguments.cfg)
    except InputError as error:
        print(f"torchvo360: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("torchvo360: interrupted.", file=sys.stderr)
        return 130


def conf_folder() -> Path:
    """Return the folder of the configuration: inside an installed package, beside that of a checkout."""
    installed = Path(__file__).parent / "conf"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "conf"


def compose(overrides: Sequence[str]) -> "RunConfig":
    """Return the settings that the overrides make of the defaults and of the embedded clip's own settings.

    Raises:
        InputError: A key or a value is not one of ours.
    """
    from hydra import compose as hydra_compose
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    with _hydra():
        config = _explained(hydra_compose, "config", overrides)
        clips = [path.stem for path in (conf_folder() / "clip").glob("*.yaml") if path.stem != "none"]
        chosen = any(override.startswith("clip=") for override in overrides)
        if config.input in clips and not chosen:
            config = _explained(hydra_compose, "config", [f"clip={config.input}", *overrides])
    try:
        OmegaConf.resolve(config)
    except OmegaConfBaseException as error:
        raise InputError(f"{error.full_key}: expected a value, got one that refers to nothing: {error.msg}.") from None

    def check(node: DictConfig, path: str) -> Any:
        """Make the dataclasses from the innermost out, so that a complaint is given the key's full name."""
        for key, child in node.items():
            if isinstance(child, DictConfig):
                check(child, f"{path}{key}.")
        try:
            return OmegaConf.to_object(node)
        except InputError as error:
            raise InputError(f"{path}{error}") from None

    return check(config, "")


def _main(overrides: list[str], multirun: bool, show: bool) -> int:
    _register()
    overrides = [_literal(override) for override in overrides] if not multirun else overrides
    _check_keys(overrides)
    if show:
        print(_yaml(compose(overrides)), end="")
        return 0
    return _sweep(overrides) if multirun else _run(overrides)


def _run(overrides: Sequence[str], folder: Path | None = None, title: str = "") -> int:
    """Do one run, into the folder where it is not left to the settings, and say what came of it."""
    from torchvo360.runner import run

    config = compose(overrides)
    if folder is not None:
        config.out = str(folder)
    outcome = run(config, config_yaml=_yaml(config))
    if outcome.lines:
        print("\n".join([title] * bool(title) + outcome.lines), flush=True)
    if outcome.complaint:
        print(f"torchvo360: {outcome.complaint}", file=sys.stderr)
    return outcome.exit_code


def _sweep(overrides: list[str]) -> int:
    """Run every combination by Hydra's sweeper and launcher, each into a numbered folder; return the worst exit code."""
    from hydra.core.global_hydra import GlobalHydra

    from torchvo360.outputs import new_folder

    outs = [override.removeprefix("out=") for override in overrides if override.startswith("out=")]
    overrides = [override for override in overrides if not override.startswith("out=")]
    if outs and "," in outs[-1]:
        raise InputError(f"out: expected one folder for the whole sweep, got {outs[-1]}.")
    if outs and any(Path(outs[-1]).glob("*")):
        raise InputError(f"out: expected a new or empty folder for a sweep, got {outs[-1]}, which holds files.")
    folder = Path(outs[-1]) if outs else new_folder(Path("runs", "sweep"))
    try:
        with _hydra():
            hydra = GlobalHydra.instance().hydra
            assert hydra is not None
            arguments = [*overrides, f"hydra.sweep.dir={_quoted(str(folder))}"]
            jobs = _explained(hydra.multirun, "config", arguments, task_function=_job, with_log_configuration=False)
    finally:
        if not any(path.is_dir() for path in folder.glob("*")):  # no job left anything
            with suppress(OSError):
                (folder / "multirun.yaml").unlink(missing_ok=True)
                folder.rmdir()
    return max(job.return_value for batch in jobs for job in batch)


def _job(_: "DictConfig") -> int:
    """Do one run of a sweep; in this process or in another one, where a launcher puts it there."""
    from hydra.core.hydra_config import HydraConfig

    _register()
    hydra = HydraConfig.get()
    overrides = list(hydra.overrides.task)
    title = f"\njob {hydra.job.num}: {hydra.job.override_dirname.replace(',', ' ') or 'no overrides'}"
    try:
        code = _run(overrides, Path(hydra.sweep.dir, str(hydra.job.num)), title)
    except InputError as error:
        print(f"torchvo360: job {hydra.job.num}: {error}", file=sys.stderr)
        return 2
    if code > 128:  # stopped by a signal: the jobs that wait are not started
        raise SystemExit(code)
    return code


def _hydra() -> AbstractContextManager[None]:
    """Return Hydra made ready for our configuration, or nothing where it is so already."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    if GlobalHydra.instance().is_initialized():
        return nullcontext()
    folder = str(conf_folder().resolve())
    ready = initialize_config_dir(version_base="1.3", config_dir=folder, job_name="torchvo360")
    return cast("AbstractContextManager[None]", ready)


def _register() -> None:
    from hydra.core.config_store import ConfigStore

    from torchvo360.settings import RunConfig

    ConfigStore.instance().store(name="schema", node=RunConfig)


def _literal(override: str) -> str:
    """Quote the value of a key that takes a path, unless it is quoted already."""
    key, equal, value = override.partition("=")
    is_path = key in PATHS or (key == "mask" and Path(value).exists())
    plain = value in ("", "null") or value[0] in "'\""
    return f"{key}={_quoted(value)}" if equal and is_path and not plain else override


def _quoted(value: str) -> str:
    escaped = re.sub(r"(\\*)(')", r"\1\1\\\2", value)
    return f"'{escaped}'"


def _check_keys(overrides: Sequence[str]) -> None:
    """Refuse overrides that Hydra cannot read and keys that are not in the schema.

    Raises:
        InputError: There is such a one.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    from torchvo360.settings import RunConfig

    schema = OmegaConf.structured(RunConfig)
    parser = OverridesParser.create()
    for text in overrides:
        key, equal, value = text.partition("=")
        if not equal and not text.startswith("~"):
            raise InputError(f"{text}: expected key=value such as input={text}.")
        try:
            override = parser.parse_override(text)
        except HydraException:
            raise InputError(f"{key}: expected a value, or one in quotes (\"{key}='...'\"), got {value}.") from None
        name = override.get_key_element().lstrip("+")
        if override.is_delete():
            raise InputError(f"{text}: expected key=value.")
        if name != "clip" and not name.startswith(("hydra.", "hydra/")) and name not in (known := _keys(schema)):
            near = _nearest(name, known)
            expected = f"a known key such as {near}" if near else "a known key (torchvo360 --cfg prints them)"
            raise InputError(f"{name}: expected {expected}, got {text}.")


def _keys(node: "DictConfig", path: str = "") -> list[str]:
    from omegaconf import DictConfig

    keys = []
    for key in node:
        keys.append(f"{path}{key}")
        if isinstance(child := node[key], DictConfig):
            keys += _keys(child, f"{path}{key}.")
    return keys


def _nearest(name: str, known: Sequence[str]) -> str | None:
    """Return the known key most like a name, by its full name or by its last part."""
    if near := difflib.get_close_matches(name, known, n=1):
        return near[0]
    last = {key.rpartition(".")[2]: key for key in known}
    near = difflib.get_close_matches(name.rpartition(".")[2], last, n=1)
    return last[near[0]] if near else None


def _explained(function: Any, name: str, overrides: Sequence[str], **options: Any) -> Any:
    """Call one of Hydra's functions, and turn its message into a sentence.

    Raises:
        InputError: Hydra refused the overrides.
    """
    from hydra.errors import HydraException, MissingConfigException

    try:
        return function(config_name=name, overrides=list(overrides), **options)
    except MissingConfigException as error:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        options_known = ", ".join(error.options or [])
        raise InputError(f"{group}: expected one of {options_known}, got {option!r}.") from None
    except HydraException as error:
        text = str(error)
        if found := re.match(r"Ambiguous value for argument '(.*?)=(.*)'|Sweep parameters '(.*?)=(.*)' req", text):
            key, value = (part for part in found.groups() if part is not None)
            raise InputError(f"{key}: expected one value (or a list [..], or -m for a sweep), got {value}.") from None
        override = text.partition("Error merging override ")[2]
        cause = str(error.__cause__ or error).partition("\n")[0]
        if not override:
            raise InputError(f"settings: expected what Hydra can compose, got: {cause.rstrip('.')}.") from None
        key, _, value = override.partition("=")
        expected = next((words for pattern, words in TYPE_ERRORS if re.search(pattern, cause)), None)
        raise InputError(
            f"{key}: expected {expected}, got {value}." if expected else f"{key}: got {value}, {cause}."
        ) from None


def _yaml(config: "RunConfig") -> str:
    from omegaconf import OmegaConf

    return OmegaConf.to_yaml(OmegaConf.structured(config))


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("torchvo360")
    except PackageNotFoundError:
        return "(a checkout that is not installed)"
