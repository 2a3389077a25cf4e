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

    `upper_friction` is the friction of the upper contact over that of the lower one. The disc's
    centre of mass lies at (`com_x`, `com_y`) [m] in the body's frame, whose origin, the contour's
    centre, is what x_C and y_C are of; `inertia` is about the centre of mass. A node that touches
    is drawn by an `adhesion` [N]; friction goes by what presses it, without that. The pads are
    `thicker` and `longer` by factors, the upper one `thicker_U` besides; their surfaces and their
    left ends stay where they are. `tilt_L` and `tilt_U` [rad] turn each pad about the middle of its
    surface. While a node sticks for a time t, mu_s grows by `ageing` ln(1 + t / `ageing_time`),
    which is lost by a slip of `renewed` [m]. A part `fast` of the pads' compliance sets in at once.

    A controller's command is held for `hold` [s], then late by `delay` [s], then limited to
    `F_x_most` and `F_y_most` [N], then it reaches the bracket by a first-order `lag` [s]; F_x and
    F_y are what reaches it. From the begin to the end of a run E falls by the part `softening` and
    friction by the part `wear`.
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
    upper_friction: float = 1.0
    com_x: float = 0.0
    com_y: float = 0.0
    adhesion: float = 0.0
    thicker: float = 1.0
    thicker_U: float = 1.0
    longer: float = 1.0
    tilt_L: float = 0.0
    tilt_U: float = 0.0
    ageing: float = 0.0
    ageing_time: float = 1e-3
    renewed: float = 1e-6
    fast: float = 0.0
    hold: float = 0.0
    delay: float = 0.0
    F_x_most: float = float("inf")
    F_y_most: float = float("inf")
    lag: float = 0.0
    softening: float = 0.0
    wear: float = 0.0
