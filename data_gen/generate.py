"""The command `python -m data_gen.generate CONFIG.toml --out DIR`; `torchsoft.datasets.generate`
does the work."""

import sys

from torchsoft.datasets.generate import main

if __name__ == "__main__":
    sys.exit(main())
