"""The entry: options, help, environment and exit codes.

Exit codes: 0 done, 1 a defect of the program (with its traceback), 2 the caller's mistake (with one sentence),
130 and 143 stopped by Ctrl-C and SIGTERM. Hydra, PyTorch and OpenCV are imported only when there is something to do.
"""

import argparse
import gc
import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from types import ModuleType

ENVIRONMENT = {
    # What OpenCV would say of a damaged file is said by us, in one sentence.
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
    "OPENCV_LOG_LEVEL": "SILENT",
    # Threads that spin while they wait make a run 20 times slower where another program uses the same cores.
    "OMP_WAIT_POLICY": "passive",
}
"""Set, unless the user has set them, before OpenCV and PyTorch are imported, which read them then."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments behind its name and return its exit code."""
    parser = argparse.ArgumentParser("torchvo360", add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    for flags in (("-m", "--multirun"), ("-c", "--cfg"), ("--version",), ("-h", "--help")):
        parser.add_argument(*flags, action="store_true")
    arguments, unknown = parser.parse_known_args(argv)
    if arguments.help:
        print((conf_folder() / "help.txt").read_text(encoding="utf-8"), end="")
        return 0
    if arguments.version:
        print(f"torchvo360 {_version()}")
        return 0
    if unknown:
        print(f"torchvo360: {unknown[0]}: expected key=value, -m, -c, --version or --help.", file=sys.stderr)
        return 2
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import_undisturbed("torchvo360.cli.jobs")
        return _main(arguments.overrides, arguments.multirun, arguments.cfg)
    except KeyboardInterrupt:
        print("torchvo360: interrupted.", file=sys.stderr)
        return 130


def conf_folder() -> Path:
    """Return the folder of the configuration: inside an installed package, beside that of a checkout."""
    package = Path(__file__).parents[1]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def import_undisturbed(module: str) -> ModuleType:
    """Import a module with Ctrl-C held back: it would leave heavy libraries half imported, and be swallowed by some.

    Raises:
        KeyboardInterrupt: Ctrl-C came meanwhile.
    """
    if threading.current_thread() is not threading.main_thread():
        return importlib.import_module(module)
    if module in sys.modules:
        return sys.modules[module]
    came = []
    before = signal.signal(signal.SIGINT, lambda *_: came.append(True))
    try:
        with _uncollected():
            imported = importlib.import_module(module)
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt
    return imported


@contextmanager
def _uncollected() -> Iterator[None]:
    """Make objects that stay, those of libraries: they are not searched for garbage, now or later.

    The collector would walk through half a million of them again and again: a tenth of the time of their import.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


def check_homes(words: Sequence[str]) -> None:
    """Refuse `~name` of an unknown user, which `Path.expanduser` answers with a RuntimeError.

    Raises:
        InputError: There is such a one.
    """
    from torchvo360.checks import InputError

    for word in words:
        key, equal, value = word.rpartition("=")
        if value.startswith("~") and os.path.expanduser(value) == value:
            raise InputError(f"{key}{': ' * bool(equal)}expected a known user's folder, got {value}.")


def _main(overrides: Sequence[str], multirun: bool, show: bool) -> int:
    from torchvo360.checks import InputError
    from torchvo360.cli.configuration import compose
    from torchvo360.cli.jobs import run_one, run_sweep
    from torchvo360.cli.overrides import to_yaml

    try:
        check_homes([word for word in overrides if "=" in word])
        if multirun:
            return run_sweep(overrides, conf_folder())
        config = compose(overrides, conf_folder())
        if show:
            print(to_yaml(config), end="")
            return 0
        return run_one(config)
    except InputError as error:
        print(f"torchvo360: {error}", file=sys.stderr)
        return 2


def _version() -> str:
    try:
        return metadata.version("torchvo360")
    except metadata.PackageNotFoundError:
        return "(a checkout that is not installed)"
