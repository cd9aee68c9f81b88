"""The command `torchvo360-eval`: errors of run folders and trajectory files, as a table.

Exit codes: 0 done, 1 a defect of the program, 2 the caller's mistake (a sentence for each; what can be evaluated is),
130 stopped by Ctrl-C.
"""

import sys
from collections.abc import Sequence

from torchvo360.cli.entry import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments behind its name and return its exit code."""
    return run_command("torchvo360-eval", "bench/evaluate.txt", "torchvo360.cli.comparison", argv)


if __name__ == "__main__":
    sys.exit(main())
