"""The command `python -m data_gen.generate CONFIG.toml --out DIR` is `torchsoft dataset make`."""

import sys

from torchsoft.cli import main

if __name__ == "__main__":
    sys.exit(main(["dataset", "make", *sys.argv[1:]]))
