"""The command `torchvo360-bench`: a data set, times presets, times seeds, as one table.

Exit codes: 0 all runs finished, 1 some failed, 2 the caller's mistake (with one sentence), 130 and 143 stopped by
Ctrl-C and SIGTERM (finished runs are kept, and the same call goes on).
"""

import sys
from collections.abc import Sequence

from torchvo360.cli.entry import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments behind its name and return its exit code."""
    return run_command("torchvo360-bench", "bench/help.txt", "torchvo360.cli.benchmark.sweep", argv)


if __name__ == "__main__":
    sys.exit(main())
