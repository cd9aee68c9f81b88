"""`python -m torchvo360` is the command `torchvo360`."""

import sys

from torchvo360.cli import main

if __name__ == "__main__":
    sys.exit(main())
