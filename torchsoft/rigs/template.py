"""The rig that `torchsoft init` writes: a disc that is pressed between two pads and rolled."""

from torchsoft.rigs.build import RigFile


def template(title: str) -> RigFile:
    """A rig that is meant to be changed."""
    pad = {
        "material": "rubber",
        "length": 80e-3,
        "height": 5e-3,
        "elements_x": 80,
        "elements_y": 4,
        "origin": (-40e-3, 0.0),
    }
    friction = {"kind": "smooth", "mu_s": 0.8, "mu_k": 0.7, "v_s": 0.05}
    return RigFile.from_tree(
        {
            "title": title,
            "bodies": {
                "disc": {
                    "mass": 0.4,
                    "shape": {"kind": "circle", "radius": 20e-3},
                    "start": {"x": 0.3e-3, "y": "rest"},
                },
                "bracket": {"mass": 0.4, "theta": 0.0, "weighted": False, "start": {"x": 0.0, "y": 50.1e-3}},
            },
            "materials": {"rubber": {"kind": "kelvin_voigt", "E": 0.75e6, "nu": 0.45, "tau": 10e-3, "depth": 44e-3}},
            "pads": {"lower": pad, "upper": pad | {"base": "bracket", "mirrored": True}},
            "laws": {"dry": {"K_n": 1.2e5, "R_n": 400.0, "K_t": 1.2e5, "R_t": 400.0, "friction": friction}},
            "contacts": {name: {"pad": name, "body": "disc", "law": "dry"} for name in ("lower", "upper")},
            "actuators": {
                "x": {"pushes": "bracket.x", "setpoint": "x_d", "Kp": 1e5, "Kd": 400.0},
                "y": {"pushes": "bracket.y", "setpoint": "y_d", "feed_forward": "press", "Kp": 1e5, "Kd": 400.0},
            },
            "motion": {
                "x_d": {"kind": "profile", "times": (0.5, 1.5), "values": ("start", 20e-3)},
                "y_d": {"kind": "profile", "times": (0.0, 0.4), "values": ("start", 49e-3)},
                "press": {"kind": "profile", "times": (0.0, 0.4), "values": (0.0, -30.0)},
            },
            "outputs": {"duration": 2.0},
        }
    )
