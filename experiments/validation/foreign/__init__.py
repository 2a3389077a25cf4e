"""A second simulator of the paper's rig, written to be plain: own finite elements, one dense Newton
system, backward Euler.

It shares no code with torchsoft, so that recordings made by it are a stranger's, and it can be told
to differ in what a fit takes for granted: the mesh, the friction law, where the disc was
put down.
"""

from experiments.validation.foreign.motion import Run, simulate
from experiments.validation.foreign.numbers import Numbers

__all__ = ["Numbers", "Run", "simulate"]
