"""Times the manipulation by equal steps under the version of torchsoft on PYTHONPATH: a wall time [s] for every line read.

The first line written is where that version lies. Used by benchmark.py; takes the simulated time [s], the step [s] and the
grasping force [N]. It imports nothing else of this folder, which an earlier version could not serve.
"""

import sys
from time import perf_counter

import torch

import torchsoft
from torchsoft import Parameters, SoftGrasp, simulate
from torchsoft.scenario import grasp_and_roll


def main() -> None:
    torch.set_num_threads(1)
    duration, step, force = map(float, sys.argv[1:])
    m = grasp_and_roll(SoftGrasp(Parameters()), grasp_force=force)
    t = torch.linspace(0, duration, round(100 * duration) + 1, dtype=torch.float64)
    print(torchsoft.__file__, flush=True)
    for _ in sys.stdin:
        start = perf_counter()
        simulate(m.model, t, y0=m.y0, step=step)
        print(perf_counter() - start, flush=True)


if __name__ == "__main__":
    main()
