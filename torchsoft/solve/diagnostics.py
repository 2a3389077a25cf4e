"""Diagnostics: the balance of a finished run's energies, the range of the theory, and stability."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.contact import SmoothSlip
from torchsoft.physics.energy import SLIPPING
from torchsoft.physics.graph import Graph, NoRates
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.motion import Profile, Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, standing, with_condensed_pads
from torchsoft.solve.steps import UNITS, rig_units
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

RESOLVED = 0.01
"""Error of one step over the largest force of the run, up to which forces count as resolved."""

NEWTON = 1e-9
"""Error of forces [N] that Newton's tolerance leaves."""

COMPRESSED = 0.5
"""Part of its height by which a pad may be pressed in: linear elasticity ends well below."""


LATER = 0.005
"""Part of a contact's largest friction by which the bound of its fall raises it without a word."""

UNLOADED = 1e-9
"""Nodal force [N] up to which a node counts as unloaded."""

SMALL_STRAIN = 0.05
"""Strain up to which linear elasticity holds without a note."""


def strained(strain: float, time: float) -> str:
    """Sentence on a strain [1] that is not small, at a time [s]."""
    return (
        f"strains reach {strain:.0%} at t = {time:.3g} s, and linear pads are accurate up to "
        f"strains of about {100 * SMALL_STRAIN:g} %; rubber is stiffer beyond (by 20 to 40 % in a "
        "layer that is pressed by a sixth of its height); use an energy such as "
        'kind = "neo_hookean"'
    )


def energy_scale(run: Trajectory) -> float:
    """Energy [J] by which a run is judged: stored at the start, and injected since."""
    return max(run.stored_energy[0].item() + run.injected[-1].item(), NEGLIGIBLE)


def missing_energy(run: Trajectory) -> float:
    """Part of `energy_scale` that a run lacks, or has too much, at the most."""
    total = lambda parts: sum(part.detach().numpy() for part in parts.values())
    stored = run.stored_energy.numpy()
    left = stored - stored[0] - total(run.supplied) + total(run.dissipated)
    return float(np.abs(left).max()) / energy_scale(run)


def doubts(trajectory: Trajectory, rig: Rig, differentiated: bool = False) -> dict[str, str]:
    """Run warnings: sentences on the faults of a finished run with a ledger, by their subject; on
    those of its gradient if it has one, or is said to be `differentiated`."""
    run, found = trajectory, dict[str, str]()
    scale, part = energy_scale(run), missing_energy(run)
    if not part <= RESIDUAL:
        longest = float(run.knots.diff().max())
        better = 0.4 * longest * min(1.0, RESIDUAL / part)
        found["energies"] = (
            f"the energies of the run do not balance: {part:.2%} of what was stored at the start "
            f"and injected since is missing or too much, with steps of {longest:.3g} s; try steps "
            f"of {better:.2g} s"
        )
    for name, energy in run.dissipated.items():
        back = -np.diff(energy.detach().numpy()).min(initial=0.0)
        if back > SUPPLIED * scale:
            found[f"dissipated {name}"] = (
                f"`{name}` is to dissipate energy, but gave {back:.3g} J back between two outputs; "
                "check its law"
            )
    if run.stats.failed_steps and "knots" in run.step_choice:
        found["knots"] = (
            "Newton did not converge in some steps between the given `knots`, which were halved "
            "(`stats.failed_steps`): the run is not one of the same steps; its own `knots` are "
            "those that it took"
        )
    slips = bool(run.dissipated["slip"][-1] > 0)
    biased = slips and (differentiated or run.y.requires_grad or run.sensitivities is not None)
    for name in rig.contacts:
        if bounded := softened(run, rig, name):
            found[f"friction {name}"] = f"contact `{name}`: {bounded}"
        if biased and (jump := jumped(run, rig, name)):
            found[f"gradient {name}"] = jump
    pairs = (np.moveaxis(x.detach().numpy(), -1, 0) for x in run.force.values())
    most = max((float(np.sqrt((N**2 + T**2).max())) for N, T in pairs), default=0.0)
    atol = run.step_choice.get("atol", 0.0)
    if 0 < RESOLVED * most < atol * UNITS["force"]:
        unit = rig_units(rig)["force"]
        if RESOLVED * most < (off := atol * unit):
            better = 0.1 * RESOLVED * most
            remedy = (
                f"atol = {better / unit:.1g}" if better >= NEWTON else "units that make them larger"
            )
            found["atol"] = (
                f"contact forces reach {most:.2g} N, and `atol` lets a step be off by {off:.2g} N: "
                f"take {remedy}"
            )
    for name, pad in rig.pads.items():
        if isinstance(pad.material, Hyperelastic):
            continue
        limit, height = COMPRESSED * pad.mesh.height, pad.mesh.height
        if not pad.nodal and 2 * largest_under_load(run, rig, name) < limit:
            continue  # other nodes are displaced less
        deepest = float(run.displacement[name].detach().norm(dim=-1).max())
        if not deepest <= limit:
            found[f"pad {name}"] = (
                f"the pad `{name}` of height {height:.3g} m gave way by {deepest:.3g} m, beyond "
                "linear elasticity"
            )
    return found


def largest_under_load(run: Trajectory, rig: Rig, name: str) -> float:
    """Largest displacement [m] of the loaded nodes of a condensed pad in a run."""
    pad, here = rig.pads[name], run.layout.slices["pads", name]
    softness = 1 / (pad.E.item() * pad.material.depth.item())
    fractions = pad.chain()[0].detach().numpy()
    z = run.y.detach().numpy()[:, here].reshape(len(run.t), len(fractions), -1)
    z = z[:, 0] if len(fractions) == 1 else fractions @ z
    loaded = np.flatnonzero(np.abs(z).max(0) > UNLOADED) // 2 * 2
    span = slice(*loaded[[0, -1]] + [0, 2]) if len(loaded) else slice(0)
    u = softness * (z[:, span] @ pad.unit_compliance()[0].numpy()[span, span])
    return float(np.sqrt((u[:, ::2] ** 2 + u[:, 1::2] ** 2).max(initial=0.0)))


@torch.no_grad()
def jumped(run: Trajectory, rig: Rig, name: str) -> str:
    """Sentence on a gradient of a run in which the slip rate of a contact's points jumps; empty
    where it does not."""
    most = float((run.force[name][..., 0].detach() / rig.weight(name)).max())
    reason = rig.contacts[name].law.jumps(most) if most > 0 else ""
    return (
        f"contact `{name}`: {reason}; the gradient of the run leaves such jumps out, so that it is "
        "zero by a static coefficient of friction and biased by all that decides when points slip"
    ) * bool(reason)


@torch.no_grad()
def softened(run: Trajectory, rig: Rig, name: str) -> str:
    """Sentence on smooth friction that falls with slip later than by its v_s, where that makes a
    contact's friction larger by more than `LATER`; empty where it does not."""
    law = rig.contacts[name].law
    slip = law.friction
    if not isinstance(slip, SmoothSlip) or slip.R_pad is None:
        return ""
    F_N, F_T = run.force[name].detach().abs().unbind(-1)
    over = slip.range(F_N / rig.weight(name), law.R_t)
    if not (over > slip.v_s).any():
        return ""
    mu, fall = F_T / F_N.clamp(min=1e-300), slip.mu_s - slip.mu_k
    speed = over * (fall / (mu - slip.mu_k).clamp(min=1e-12) - 1).clamp(min=0.0)
    later = (mu - slip.mu_k - fall / (1 + speed / slip.v_s)).clamp(min=0.0)
    slips = run.contact_state[name] == SLIPPING
    extra = torch.where(slips, later * F_N, 0.0).sum(-1)
    if extra.max() <= LATER * slip.mu_s * F_N.sum(-1).max():
        return ""
    return (
        "friction falls from mu_s to mu_k over a larger slip speed than v_s, since a pad of that "
        "little damping has no single velocity otherwise (`SmoothSlip.R_pad`); where that matters "
        "take mu_k = mu_s, or a pad with a larger tau_instant"
    )


# Stability of the closed loop: the linearised modes of a rig about a state of rest. A loop that
# measures one body and pushes another through soft pads, non-collocated, is unstable for many
# combinations of gains, stiffness and damping.


DISPLACEMENT, VELOCITY = 1e-9, 1e-8
"""Perturbations [m or rad], [m/s or rad/s] of the differences: small against penetrations,
so that nodes stick."""

CONTROL = 1e-6
"""Perturbation of a state of an actuator over its size, or over one of its unit."""

NEUTRAL = 0.1
"""Growth rate [1/s] up to which a mode counts as neutral, as the angle of a round body is."""


AT_ONCE = 64
"""Components that are perturbed in one call, which bounds the memory."""


@torch.no_grad()
def linearised(
    model: Graph, y: Tensor, reference: Reference, only: Sequence[int] | None = None
) -> Tensor:
    """dy'/dy (size, size) at a state y (size,) of rest, with touching and sticking as they are
    there; `only` takes some of the components. In plain torch: compiling the kernels would take
    longer."""
    size = torch.full((model.layout.size,), DISPLACEMENT, dtype=torch.float64)
    for block, where, unit in model.layout.groups():
        if block.field == "friction":
            size[where] = DISPLACEMENT * y[where].abs()
        elif block.field == "control":
            size[where] = CONTROL * y[where].abs().clamp(min=1.0)
        elif unit == "N":  # forces, counted by the displacement they make
            size[where] = DISPLACEMENT / float(model.pads[block.name].compliance().diagonal().max())
        elif unit.endswith("/s"):
            size[where] = VELOCITY
    which = torch.arange(len(size)) if only is None else torch.tensor(only, dtype=torch.long)
    columns, here = [], model(0.0, y, reference)
    for some in which.split(AT_ONCE):
        ahead = model(0.0, y + torch.diag(size)[some], reference)
        columns.append((ahead - here)[:, which] / size[some, None])
    return torch.cat(columns).mT


class Modes(NamedTuple):
    """Eigenvalues [1/s], complex, the least stable first, and the coordinate that moves most in the
    first of them, "" where none is free."""

    values: Tensor
    moves: str


@torch.no_grad()
def modes(rig: Graph, y: Tensor, reference: Reference) -> Modes:
    """Modes of a rig with massless pads about a state y (size,) at rest, pads settled, under a
    constant `reference`. Unbalanced constant loads do not change them; touching and sticking points
    do.

    Away from contact nodal forces and stretches fade by themselves, independently of the rest:
    those modes are left out. An angle counts by the radius of gyration. There are none where a
    pad's rates are not to be found.
    """
    state, layout = rig.unpack(y, rig.follow(0.0, reference)), rig.layout
    acting = torch.ones(layout.size, dtype=torch.bool)
    for name, forces in state.pads.items():
        acting[layout.slices["pads", name]] = (
            (forces != 0).any(-1, keepdim=True).expand(forces.shape).flatten()
        )
    for name in rig.contacts:
        acting[layout.slices["stretch", name]] = rig.penetration(name, state) > 0
    none = Modes(torch.zeros(0, dtype=torch.complex128), "")
    if not (only := acting.nonzero()[:, 0].tolist()):
        return none
    try:
        values, vectors = torch.linalg.eig(linearised(rig, y, reference, only))
    except NoRates:
        return none
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


LOOPS = 2.0
"""Growth rate of a mode over that without loops, from which on the loops are its cause."""

POSES = 10
"""Largest number of poses in which pads are settled to look for an unstable loop."""

UNSTABLE = "lower the gains, raise the pads' tau or E, or measure what is pushed"
"""Remedies for an unstable loop."""


@torch.no_grad()
def instability(rig: Rig, run: Trajectory) -> str:
    """A message on an unstable loop with its remedy, from the modes about the pose in which the
    contacts of a run carried most, each of them, and in which the pads settle; empty where no mode
    grows there, or one does without loops."""
    if not run.force or not rig.actuators:
        return ""
    soft = with_condensed_pads(rig)
    least = torch.stack([force.detach()[..., 0].sum(-1) for force in run.force.values()]).amin(0)
    for k in least.argsort(descending=True)[:POSES].tolist():
        try:
            y = standing(soft, {name: pose[k].detach() for name, pose in run.state.pose.items()})
            break
        except NoEquilibrium:
            continue
    else:
        return ""
    constant = Reference(**{name: Profile([0.0], [float(run[name][k])]) for name in rig.signals})
    values, moves = modes(soft, y, constant)
    free = Graph(
        bodies=rig.bodies, pads=soft.pads, contacts=rig.contacts, reference=rig.reference,
        gravity=float(rig.gravity), symbols=rig.symbols,
    )  # fmt: skip
    passive = y[: free.layout.size]  # without states of actuators, which come last
    alone = float(modes(free, passive, constant).values.real.amax()) if len(values) else 0.0
    if not len(values) or float(values[0].real) <= LOOPS * max(alone, NEUTRAL):
        return ""
    leading = complex(values[0])
    return (
        f"the closed loop is unstable: its leading mode is {leading.real:+.3g} "
        f"{leading.imag:+.3g}j 1/s, mostly of {moves}; {UNSTABLE}"
    )
