"""The command `python -m data_gen.check DIR` is `torchsoft dataset check`."""

import sys

from torchsoft.cli import main

if __name__ == "__main__":
    sys.exit(main(["dataset", "check", *sys.argv[1:]]))
