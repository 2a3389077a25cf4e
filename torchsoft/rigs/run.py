"""Run of a rig file into a folder of results: the trajectory, a summary in numbers, figures and a
video."""

import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchsoft.cost import Cost, row_bytes, step_time, steps_per_second
from torchsoft.diagnostic import Diagnostic
from torchsoft.display import hidden
from torchsoft.files import make_folder, write_json
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.mesh import Mesh
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.check import EFFORT, LOOSE, ROWS
from torchsoft.rigs.fields import at_field
from torchsoft.rigs.findings import Run, strains
from torchsoft.solve.diagnostics import doubts
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import RTOL, Interrupted, simulate
from torchsoft.solve.trajectory import Trajectory
from torchsoft.tables import plain


def carry_out(file: RigFile, *, progress: bool = False) -> Run:
    """Simulate a rig file. A failure or Ctrl-C ends the run early; the outcome then holds the run
    so far.

    Raises `ValueError` for a rig that cannot be built, and `KeyboardInterrupt` before anything was
    simulated.
    """
    ready = file.build()
    try:
        run = simulate(
            ready.rig, ready.t, y0=ready.y0, **file.solver.model_dump(), progress=progress
        )
    except (SimulationFailed, Interrupted) as stop:
        if stop.trajectory is None:
            raise
        return Run(ready, stop.trajectory, stop)
    return Run(ready, run, None)


def run(
    file: RigFile, out: Path, *, found: list[Diagnostic] | None = None, progress: bool = False
) -> Run:
    """Simulate and write the results to the folder `out`: data first, pictures only of complete
    runs. `found` are findings of the check, for the summary. Raises `OSError` for a folder that
    cannot be made, and the errors of `carry_out`."""
    began = time.perf_counter()
    make_folder(out)
    done = carry_out(file, progress=progress)
    done.trajectory.save(out / "trajectory.nc")
    numbers = summary(file, done, found or []) | {"wall_s": time.perf_counter() - began}
    write_json(out / "summary.json", numbers)
    if done.stopped is None:
        draw(file, done.trajectory, out, progress)
    return done


def summary(file: RigFile, done: Run, found: list[Diagnostic]) -> dict[str, Any]:
    """The run in numbers, in SI units, and its provenance."""
    run, rig = done.trajectory, done.ready.rig
    return {
        "title": file.title,
        "stopped": done.stopped and getattr(done.stopped, "reason", "interrupted"),
        "simulated_s": float(run.t[-1]),
        "bodies": {name: coordinates(rig, run, name) for name in rig.bodies},
        "contacts": {
            name: {
                "largest_normal_force_N": float(force[..., 0].sum(-1).max()),
                "normal_force_at_end_N": float(force[-1, :, 0].sum()),
                "largest_net_friction_N": float(force[..., 1].sum(-1).abs().max()),
                "most_points_touching": int((force[..., 0] > 0).sum(-1).max()),
            }
            for name, force in run.force.items()
        },
        "pads": {
            name: {
                "largest_displacement_over_height": float(u.norm(dim=-1).max())
                / rig.pads[name].mesh.height,
                "largest_strain": largest_strain(run, name),
            }
            for name, u in run.displacement.items()
        },
        "actuators": {
            name: {"largest_effort": float(run[one.channel].abs().max())}
            for name, one in run.setup.actuators.items()
        },
        "energy": {
            "injected_J": float(run.injected[-1]),
            "dissipated_J": {name: float(work[-1]) for name, work in run.dissipated.items()},
            "worst_imbalance_J": float(run.energy_residual.abs().max()),
            "worst_imbalance_over_injected": run.energy_residual_rel,
        },
        "doubts": list(doubts(run, rig).values()),
        "notes": [str(one) for one in strains(done)],
        "stepping": vars(run.stats) | {"newton_per_step": run.stats.newton_per_step},
        "findings": [one._asdict() for one in found],
        "torchsoft": version("torchsoft"),
        "file": file.model_dump(mode="json", exclude_none=True),
    }


def largest_strain(run: Trajectory, pad: str) -> float:
    """The largest strain [1] of a pad, where it gives way most."""
    u = run.displacement[pad].detach()
    row = int(u.norm(dim=-1).amax(-1).argmax())
    return float(run.setup.pads[pad].largest_strain(u[row].numpy()))


def coordinates(rig: Rig, run: Trajectory, body: str) -> dict[str, dict[str, float]]:
    """Start, end, least and largest value of a body's coordinates that are not fixed [m, rad]."""
    rows = zip(COORDINATES, run.state.pose[body].detach().mT.tolist())
    return {
        axis: {"start": place[0], "end": place[-1], "least": min(place), "largest": max(place)}
        for axis, place in rows if rig.bodies[body].freedom[axis] != "fixed"
    }  # fmt: skip


def cost(file: RigFile, runs: bool) -> Cost:
    """Cost of a check, and with `runs` of a run after it. Raises `ValueError` for a mesh file that
    cannot be read."""
    span, solver = file.outputs.duration, file.solver
    steps, rows = min(span * steps_per_second(LOOSE), EFFORT), float(ROWS)
    if runs and solver.step is not None:
        steps += span / solver.step
    elif runs:
        steps += span * steps_per_second(solver.rtol or RTOL)
    if runs:
        rows += span / file.outputs.interval
    meshes = list[Mesh]()
    seconds, memory = 0.0, 0.0
    for name, table in file.pads.items():
        with at_field(f"pads.{name}"):
            mesh = table.mesh(file.folder)
        meshes.append(mesh)
        material = file.materials[table.material].build(file.folder)
        finite = isinstance(material, Hyperelastic)
        fields = material.branches if finite else 1
        nodal = table.inertial or finite
        surface, free, _ = mesh.counts()
        points = table.points * surface
        seconds += 0.5 * steps * step_time(surface, points, free if nodal else 0, finite, fields)
        memory += rows * row_bytes(fields * free if nodal else surface, points) / 2**30
    return Cost(steps, seconds, memory + max(mesh.memory for mesh in meshes))


def draw(file: RigFile, run: Trajectory, out: Path, progress: bool) -> None:
    """Write the figures, the player and the video of a rig file to `out`."""
    # matplotlib takes half a second, which `check` does not need
    from torchsoft.plot import figures
    from torchsoft.plot.animation import animate, player
    from torchsoft.plot.dashboard import dashboard

    title = plain(file.title)
    made = {
        "dashboard": lambda: dashboard(run, title=title),
        "snapshots": lambda: figures.snapshots(run, file.outputs.snapshots, title=title),
    }
    if file.outputs.figures:
        for name, figure in tqdm(made.items(), "figures", unit="figure", disable=hidden(progress)):
            figures.save(figure(), out / f"{name}.png")
    if file.outputs.figures if file.outputs.player is None else file.outputs.player:
        player(run, out / "player.html", title=title)
    if file.outputs.video != "none":
        animate(
            run, out / f"video.{file.outputs.video}", frames=file.outputs.frames,
            progress=progress, title=title, follow=file.outputs.follow,
        )  # fmt: skip
