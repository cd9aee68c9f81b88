"""The command `torchvo360-export`: a run's result in other programs' formats, or a posed data set from a video.

Exit codes: 0 done, 1 a defect of the program, 2 the caller's mistake (with one sentence), 130 and 143 stopped by Ctrl-C
and SIGTERM; what was there before is then as it was.
"""

import sys
from collections.abc import Sequence

from torchvo360.cli.entry import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments behind its name and return its exit code."""
    return run_command("torchvo360-export", "export/help.txt", "torchvo360.cli.exporting", argv)


if __name__ == "__main__":
    sys.exit(main())
