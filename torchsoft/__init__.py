"""torchsoft: a differentiable simulator of soft contact manipulation.

    import torch
    from torchsoft import SoftGrasp, simulate

    rig = SoftGrasp()                                 # the paper's rig; print(rig)
    y0 = rig.state(disc={"x": 0.06, "y": "rest"}, bracket={"x": 0.06, "y": 0.051})
    run = simulate(rig, torch.linspace(0, 0.1, 11), y0=y0, gradient="discrete")
    run["y_C"], run.force["L"]                        # channels, forces of every node, SI units
    run["y_C"][-1].backward()                         # rig.parameter("pad.E").grad
    run.plot(); run.animate("run.html"); run.save("run.nc")

What there is, each with a page of its own in help():

rigs        SoftGrasp, Parameters; Rig, Body, Pad, Contact, SoftContact, Actuator, PD,
            StateFeedback, controller; rig files: torchsoft.rigs.RigFile
meshes      PadMesh, CurvedPadMesh, FingertipMesh, QuadMesh
materials   KelvinVoigt, StandardLinearSolid, GeneralisedKelvin, Prony
shapes      Circle, Ellipse, Superellipse, RoundedBox, RoundedPolygon, Contour
friction    SmoothSlip, Coulomb, or any torch function
motions     Reference, Profile, Sampled, hold
runs        simulate, simulate_batch, Trajectory, Batch; rest, press; register_method (torchdiffeq)
beyond      torchsoft.sysid (identification), torchsoft.reduced, torchsoft.datasets, torchsoft.envs
            (gymnasium), torchsoft.plot, torchsoft.testing (checks for pytest)

The command `torchsoft --help` runs rig files. Names are imported when they are first used.
"""

import sys

import lazy_loader

_lazy, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("torchsoft")
    if name == "__all__" and sys._getframe(1).f_globals.get("__name__") != "pydoc":
        return _names  # which help() is not told: it would print the pages of all of them
    return _lazy(name)
