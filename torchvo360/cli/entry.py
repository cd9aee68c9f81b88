"""The entry that smaller commands share: help, environment, and one sentence for the caller's mistake."""

import os
import signal
import sys
from collections.abc import Sequence

from torchvo360.cli.command import ENVIRONMENT, check_homes, conf_folder, import_undisturbed


def run_command(name: str, help_file: str, module: str, argv: Sequence[str] | None) -> int:
    """Run a command and return its exit code: its own, or 2, 130 or 141 for what is told below.

    2 is the caller's mistake, told in one sentence, 130 Ctrl-C, 141 that nobody reads the output any more.

    Args:
        name: The command's name.
        help_file: Its help, below the folder of the configuration.
        module: Where its function `run` is, which takes the words behind the name and returns the exit code. It is
            imported when there is something to do: OpenCV and PyTorch read the environment at their import.
        argv: The words behind the name; None for those of the process.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if "-h" in words or "--help" in words:
        print((conf_folder() / help_file).read_text(encoding="utf-8"), end="")
        return 0
    for key, value in ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    try:
        command = import_undisturbed(module)
        from torchvo360.checks import InputError

        try:
            check_homes(words)
            return command.run(words)
        except InputError as error:
            print(f"{name}: {error}", file=sys.stderr)
            return 2
    except BrokenPipeError:  # who read the output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it flushes at the end
        return 128 + signal.SIGPIPE
    except KeyboardInterrupt:
        print(f"{name}: interrupted.", file=sys.stderr)
        return 130
