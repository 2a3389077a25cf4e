"""Checks of a finished run: whether its energies balance, and whether its pads are pressed beyond
the theory."""

from torchsoft.physics.rig import Rig
from torchsoft.solve.trajectory import Trajectory

RESIDUAL = 0.05
"""Energy residual over the energy at the start and injected since, up to which a run passes without
a warning: fifteen times that of the hardest of the ready excitations at steps of 2 ms."""

NEGLIGIBLE = 1e-9
"""Energy [J] too small to be judged."""

SUPPLIED = 1e-9
"""Part of that energy by which the dissipated energy may fall: rounding."""

COMPRESSED = 0.5
"""Part of its height by which a pad may be pressed in: linear elasticity ends well below."""


def doubts(trajectory: Trajectory, rig: Rig) -> dict[str, str]:
    """Sentences on the faults of a finished run that has a ledger, by their subject; none if there
    are none."""
    run, found = trajectory, {}
    stored = sum(float(part[0].detach()) for part in run.energy.values())
    scale = max(stored + float(run.injected[-1].detach()), NEGLIGIBLE)
    part = float(run.energy_residual.detach().abs().max()) / scale
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
