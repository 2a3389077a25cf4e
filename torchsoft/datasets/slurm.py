"""A job array of SLURM for a dataset in parts; each part can be submitted alone and repeatedly."""

import math
import shlex
import sys
from pathlib import Path

from torchsoft.cost import span
from torchsoft.datasets.config import Config
from torchsoft.datasets.files import folder
from torchsoft.datasets.generate import Part, estimate, unfinished

SPARE, LEAST = 3.0, 600.0
"""Requested time over the estimate [1], and least requested time [s]."""

BASE = 1.5
"""Memory of a process [GiB] without its shard."""

BEGINNING = 5
"""Time [s] that a process takes to begin with its first shard."""

SCRIPT = """\
#!/bin/bash
#SBATCH --job-name={name}
#SBATCH --array={array}
#SBATCH --cpus-per-task=1
#SBATCH --mem={memory}G
#SBATCH --time={hours:02d}:{minutes:02d}:00
#SBATCH --output=%x-%A_%a.log
# Add what your cluster wants, such as --partition and --account. A part that was stopped, or a job
# that is submitted again, makes what is missing. Then: {check}
export OMP_NUM_THREADS=1
exec {command} --part "$SLURM_ARRAY_TASK_ID/{parts}" --workers "${{SLURM_CPUS_PER_TASK:-1}}" --yes
"""


def job_array(path: Path, url: str, parts: int) -> tuple[str, str]:
    """The script for `sbatch`, and a sentence on its cost. Raises `ValueError` for more parts than
    shards, and where no shard is left to make."""
    config = Config.from_toml(path)
    lacking = set(unfinished(config, url))
    left = [i for i in range(1, parts + 1) if lacking & set(Part(i, parts).shards(config))]
    if parts < 1 or not left:
        raise ValueError(
            f"--parts should be 1 or more, not {parts}" if parts < 1
            else f"{url}: all {config.shards} shards are finished; there is nothing to be made"
        )  # fmt: skip
    out = str(here.absolute()) if (here := folder(url)) else url
    program = [sys.executable, "-m", "torchsoft", "dataset"]
    whole = estimate(config, url, 1)
    most = max(len(lacking.intersection(Part(i, parts).shards(config))) for i in left)
    price = whole.part(most / len(lacking))
    minutes = math.ceil(max(SPARE * price.seconds, LEAST) / 60)
    estimates = (
        f"each of {len(left)} tasks: {price.sentence}; all of them: "
        f"{span(whole.least, whole.seconds)} of one core, {whole.disk:.2g} GiB on the disk; "
        f"every task also takes {BEGINNING:g} s to start and {BASE:g} GiB for its process"
    )
    script = SCRIPT.format(
        name=f"torchsoft-{path.stem}".replace(" ", "-"), parts=parts,
        array=f"1-{parts}" if len(left) == parts else ",".join(map(str, left)),
        memory=math.ceil(BASE + 1.5 * price.memory), hours=minutes // 60, minutes=minutes % 60,
        command=shlex.join([*program, "make", str(path.absolute()), "--out", out]),
        check=shlex.join([*program, "check", out]),
    )  # fmt: skip
    return script, estimates
