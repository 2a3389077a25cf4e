"""torchsoft: a differentiable simulator of soft contact manipulation.

    from torchsoft import RigFile

    built = RigFile.ready("paper").build()  # the paper's rig
    run = built.run(gradient="discrete")    # 30 s; a Trajectory
    run["theta_C"], run.force["L"]          # channels, forces of every node, SI units
    run["theta_C"][1000].backward()         # rig.parameter("materials.rubber.E").grad
    run.plot(); run.animate("run.html"); run.save("run.nc")

What there is, each with a page of its own in help():

rigs        RigFile, BuiltRig, excite; Rig, Body, Pad, Contact, SoftContact, Actuator, PD,
            Integral, Lagging, StateFeedback, controller
meshes      PadMesh, CurvedPadMesh, FingertipMesh, QuadMesh
materials   KelvinVoigt, StandardLinearSolid, GeneralisedKelvin, Prony; at finite strain NeoHookean,
            MooneyRivlin, Yeoh, Ogden, Hyperelastic (a custom energy)
shapes      Circle, Ellipse, Superellipse, RoundedBox, RoundedPolygon, Contour,
            Eccentric
friction    SmoothSlip, AgeingSlip, Coulomb, RateAndState, or any torch function
motions     Reference, Profile, Sampled, hold
runs        simulate, simulate_batch, Trajectory, Batch; register_method (torchdiffeq)
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
