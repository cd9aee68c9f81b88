"""The command `torchvo360-plan`: a map of the floor from a run, and a robot's way on it.

Exit codes: 0 a way was found, 3 there is none (its reason is printed), 1 a defect of the program, 2 the caller's
mistake (with one sentence), 130 stopped by Ctrl-C.
"""

import sys
from collections.abc import Sequence

from torchvo360.cli.entry import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments behind its name and return its exit code."""
    return run_command("torchvo360-plan", "plan/help.txt", "torchvo360.cli.planning", argv)


if __name__ == "__main__":
    sys.exit(main())
