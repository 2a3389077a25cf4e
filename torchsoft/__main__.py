"""`python -m torchsoft` is the command `torchsoft`."""

import sys

from torchsoft.cli import main

if __name__ == "__main__":
    sys.exit(main())
