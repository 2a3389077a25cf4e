"""Diagnostics: the balance of a finished run's energies, the range of the theory, and stability."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchsoft.paper.equilibrium import holding_force, press
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.motion import Reference, hold
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.solve.trajectory import Trajectory

# Checks of a finished run: whether its energies balance, and whether its pads are pressed beyond
# the theory.


RESIDUAL = 0.05
"""Energy residual over the energy at the start and injected since, up to which a run passes without
a warning: fifteen times that of the hardest of the ready excitations at steps of 2 ms."""

NEGLIGIBLE = 1e-9
"""Energy [J] too small to be judged."""

SUPPLIED = 1e-9
"""Part of that energy by which the dissipated energy may fall: rounding."""

COMPRESSED = 0.5
"""Part of its height by which a pad may be pressed in: linear elasticity ends well below."""


SMALL_STRAIN = 0.05
"""Strain up to which linear elasticity holds without a note."""


def strained(strain: float, time: float) -> str:
    """Sentence on a strain [1] that is not small, at a time [s]."""
    return (
        f"strains reach {strain:.0%} at t = {time:.3g} s, and linear pads hold to "
        f"{SMALL_STRAIN:.0%} or so: rubber is stiffer beyond, by 20 to 40 % in a layer that is "
        "pressed by a sixth of its height"
    )


def energy_scale(run: Trajectory) -> float:
    """Energy [J] by which a run's ledger is judged: stored at the start, and injected since."""
    stored = sum(float(part[0].detach()) for part in run.energy.values())
    return max(stored + float(run.injected[-1].detach()), NEGLIGIBLE)


def missing_energy(run: Trajectory) -> float:
    """Part of `energy_scale` that a run's ledger lacks, or has too much, at the most."""
    return float(run.energy_residual.detach().abs().max()) / energy_scale(run)


def doubts(trajectory: Trajectory, rig: Rig) -> dict[str, str]:
    """Sentences on the faults of a finished run that has a ledger, by their subject; none if there
    are none."""
    run, found = trajectory, {}
    scale, part = energy_scale(run), missing_energy(run)
    if not part <= RESIDUAL:
        longest = float(run.knots.diff().max())
        better = 0.4 * longest * min(1.0, RESIDUAL / part)
        found["energies"] = (
            f"the energies of the run do not balance: {part:.2%} of what was stored at the start "
            f"and injected since is missing or too much, with steps of {longest:.3g} s; try steps "
            f"of {better:.2g} s"
        )
    for name, work in run.dissipated.items():
        back = -float(work.detach().diff(prepend=work[:1].detach()).min())
        if back > SUPPLIED * scale:
            found[f"dissipated {name}"] = (
                f"`{name}` is to dissipate energy, but gave {back:.3g} J back between two outputs; "
                "check its law"
            )
    if run.stats.failed_steps and "knots" in run.made_by["steps"]:
        found["knots"] = (
            f"Newton did not converge in {run.stats.failed_steps} of the steps between the given "
            "`knots`, which were halved: the run is not one of the same steps; its own `knots` are "
            "those that it took"
        )
    for name, u in run.displacement.items():
        deepest, height = float(u.detach().norm(dim=-1).max()), rig.pads[name].mesh.height
        if not deepest <= COMPRESSED * height:
            found[f"pad {name}"] = (
                f"the pad `{name}` of height {height:.3g} m gave way by {deepest:.3g} m, beyond "
                "linear elasticity"
            )
    return found


# Stability of the closed loop: the linearised modes of any rig about a state of rest, of the
# grasped system about its own.
#
# The horizontal loop senses the disc and pushes the bracket, through two soft pads:
# non-collocated, and unstable for many combinations of gains, pad stiffness and pad damping.


DISPLACEMENT, VELOCITY = 1e-9, 1e-8
"""Perturbations [m or rad], [m/s or rad/s] of the central differences: small against penetrations,
so that nodes stick."""

NEUTRAL = 0.1
"""Growth rate [1/s] up to which a mode counts as neutral; the disc's angle is one."""


AT_ONCE = 64
"""Components that are perturbed in one call, which bounds the memory."""


@torch.no_grad()
def linearised(
    model: Rig, y: Tensor, reference: Reference, only: Sequence[int] | None = None
) -> Tensor:
    """dy'/dy (size, size) at a state y (size,) of rest, with touching and sticking as they are
    there; `only` takes some of the components. In plain torch: compiling the kernels would take
    longer."""
    size = torch.full((model.layout.size,), DISPLACEMENT, dtype=torch.float64)
    for (part, name), where in model.layout.slices.items():
        if (
            part == "pads" and not model.pads[name].inertial
        ):  # forces, counted by the displacement they make
            size[where] = DISPLACEMENT / float(model.pads[name].compliance().diagonal().max())
        elif part in ("rates", "velocity"):
            size[where] = VELOCITY
    which = torch.arange(len(size)) if only is None else torch.tensor(only, dtype=torch.long)
    columns = []
    for some in which.split(AT_ONCE):
        d = torch.diag(size)[some]
        ahead, behind = (model(0.0, y + sign * d, reference) for sign in (1, -1))
        columns.append((ahead - behind)[:, which] / (2 * size[some, None]))
    return torch.cat(columns).mT


class Modes(NamedTuple):
    """Eigenvalues [1/s], complex, the least stable first, and the coordinate that moves most in the
    first of them, "" where none is free."""

    values: Tensor
    moves: str


@torch.no_grad()
def modes(rig: Rig, y: Tensor, reference: Reference) -> Modes:
    """Modes of a rig with massless pads about a state y (size,) at rest, pads settled, under a
    constant `reference`. Unbalanced constant loads do not change them; touching and sticking points
    do.

    Away from contact nodal forces and stretches fade by themselves, independently of the rest:
    those modes are left out. An angle counts by the radius of gyration.
    """
    state, layout = rig.unpack(y, rig.follow(0.0, reference)), rig.layout
    acting = torch.ones(layout.size, dtype=torch.bool)
    for name, forces in state.pads.items():
        acting[layout.slices["pads", name]] = (
            (forces != 0).any(-1, keepdim=True).expand(forces.shape).flatten()
        )
    for name in rig.contacts:
        acting[layout.slices["stretch", name]] = rig.penetration(name, state) > 0
    if not (only := acting.nonzero()[:, 0].tolist()):
        return Modes(torch.zeros(0, dtype=torch.complex128), "")
    values, vectors = torch.linalg.eig(linearised(rig, y, reference, only))
    order = values.real.argsort(descending=True)
    most, moves = -1.0, ""
    for name, axes in rig.layout.free.items():
        mass, _, inertia = (float(m.detach()) for m in rig.bodies[name].masses)
        for i, axis in enumerate(axes):
            at = only.index(layout.slices["pose", name].start + i)
            size = float(vectors[at, order[0]].abs()) * (
                (inertia / mass) ** 0.5 if axis == 2 else 1.0
            )
            if size > most:
                most, moves = size, f"{name}.{COORDINATES[axis]}"
    return Modes(values[order], moves)


@torch.no_grad()
def loop_modes(model: SoftGrasp) -> Tensor:
    """Eigenvalues [1/s] of the linearised closed loop in the grasp, complex, the least stable
    first.

    The grasp is the frictionless equilibrium at the scenario's y_Br(t_g), with every touching node
    sticking. Raises `NoEquilibrium` when that grasp does not exist.
    """
    y = press(model, model.settings.scenario.y_Br_grasp)
    pose = model.unpack(y).pose
    reference = hold(
        x_d=float(pose["disc"][0]), y_d=float(pose["bracket"][1]), F_ff=-holding_force(model, y)
    )
    return modes(model, y, reference).values


def describe_instability(model: SoftGrasp) -> str:
    """A sentence on an unstable loop with its remedy; empty when the loop is stable."""
    leading = complex(loop_modes(model)[0])
    if leading.real <= NEUTRAL:
        return ""
    names = [
        name for name, _ in model.pads["L"].material.named_parameters() if name.startswith("tau")
    ]
    slower = ", ".join(f"pad.{name}" for name in names if name != "tau_instant")
    return (
        f"the closed loop is unstable: its leading mode is {leading.real:+.3g} "
        f"{leading.imag:+.3g}j 1/s; raise {slower} or pad.E, or lower control.K_81"
    )
