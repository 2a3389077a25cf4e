"""The numbers of the rig, and what may be chosen about its laws; SI units."""

from typing import NamedTuple


class Numbers(NamedTuple):
    """One rig. Contact numbers are those of a node that stands for `spacing` of surface.

    `literal` takes Eq. 12-13 of the paper to the letter: a spring and a dashpot from the place of
    first contact until the force in them is above mu_s F_N, then mu_k F_N against the sliding, and
    the spring goes on stretching. `senses_disc`: the horizontal loop measures the disc.

    `upper` is the stiffness of the upper pad over that of the lower one; the penalty force grows
    with the depth to a `power`, from the same force at the depth `same`; a part `slow` of the pads'
    compliance sets in over `slow_tau`; the horizontal guide of the bracket has a dry `friction`,
    smooth below the speed `creep`; `inertia` is the disc's over that of a uniform one; gravity is
    turned by a `tilt`.
    """

    K_n: float = 1.2e5
    R_n: float = 441.7149
    K_t: float = 1.2e5
    R_t: float = 441.7149
    mu_s: float = 0.8
    mu_k: float = 0.7
    v_s: float = 0.05
    spacing: float = 1e-3
    literal: bool = False
    E: float = 0.75e6
    nu: float = 0.45
    tau: float = 0.01
    length: float = 0.12
    height: float = 4.59e-3
    depth: float = 0.044
    across: int = 120
    through: int = 4
    radius: float = 19.37e-3
    mass: float = 0.4065
    bracket_mass: float = 0.4065
    cm_height: float = 2.18e-3
    gravity: float = 9.81
    K_x: float = 1.2e5
    R_x: float = 441.7149
    K_y: float = 1.2e5
    R_y: float = 441.7149
    senses_disc: bool = True
    x_C0: float = 60e-3
    upper: float = 1.0
    power: float = 1.0
    same: float = 1e-4
    slow: float = 0.0
    slow_tau: float = 0.15
    friction: float = 0.0
    creep: float = 1e-3
    inertia: float = 1.0
    tilt: float = 0.0
