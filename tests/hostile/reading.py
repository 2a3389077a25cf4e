"""Reads the trajectory files that it is given on standard input, one a line, and says what came of
each in a line of JSON.

A process of its own: damage may make the libraries crash, and that must be seen.
"""

import hashlib
import json
import sys
import traceback
import warnings
from pathlib import Path

import numpy as np

from torchsoft.sysid.columns import read_table

warnings.simplefilter("ignore")
print("ready", flush=True)
for name in sys.stdin:
    try:
        table = read_table(Path(name.strip()))
        values = b"".join(
            k.encode() + column.tobytes() for k, column in sorted(table.values.items())
        )
        finite = all(bool(np.isfinite(column).all()) for column in table.values.values())
        said = {"read": hashlib.sha256(values).hexdigest(), "finite": finite}
    except (ValueError, OSError) as refusal:
        said = {"refused": str(refusal)}
    except BaseException as error:
        said = {"raised": "".join(traceback.format_exception(error))[-1500:]}
    print(json.dumps(said), flush=True)
