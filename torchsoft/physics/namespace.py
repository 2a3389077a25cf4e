"""Names that follow from a rig's parts: one namespace of channels and arrays of files, one of
junctions. Two of one name would replace each other in silence.
"""

from collections.abc import Iterator
from typing import NamedTuple

from torchsoft.physics.graph import Graph
from torchsoft.physics.multibond import GROUND
from torchsoft.physics.names import FORCES, ON_BODY, effort_channel, rate_channel
from torchsoft.physics.parts import COORDINATES, coordinate_unit

FORMAT = (
    "t", "time", "axis", "coordinate", "body", "pose", "velocity", "loads", "injected",
    "energy_residual", "knot", "knots", "component", "unknown", "sensitivities",
)  # fmt: skip
"""Arrays and dimensions of every file of a run."""

OF_CONTACT = (
    "normal_force_{}", "friction_force_{}", "stretch_{}", "friction_state_{}", "contact_state_{}",
    "{}_state", "{}_point",
)  # fmt: skip
OF_PAD = (
    "displacement_{}", "velocity_{}", "nodal_force_{}", "relaxing_{}", "mesh_nodes_{}",
    "mesh_elements_{}", "mesh_bonded_{}", "mesh_face_{}", "energy_strain_{}",
    "energy_kinetic_{}", "dissipated_pad_{}", "{}_node", "{}_branch", "{}_mesh_node", "{}_element",
    "{}_face",
)  # fmt: skip
OF_BODY = "outline_{}", "energy_{}", "energy_{}_spin", "supplied_drive_{}", "{}_outline"
OF_ACTUATOR = "supplied_control_{}", "control_{}", "{}_control"
OF_RIG = (
    "energy_normal_springs", "energy_tangential_springs", "dissipated_contact_dashpots",
    "dissipated_slip", "supplied_gravity",
)  # fmt: skip
"""Arrays and dimensions of a file by the part that they belong to."""


POSE, RATE, EFFORT = "pose", "rate", "effort"
"""Kinds of channels that a sensor can measure."""


class Channel(NamedTuple):
    """A channel of a run: its name, SI unit, owner and meaning, and what it measures of the motion
    of a free coordinate, if anything."""

    name: str
    unit: str
    owner: str
    meaning: str
    measures: str = ""


def declared(rig: Graph) -> Iterator[Channel]:
    """Every channel; a signal's unit follows from its use, and one with several uses comes several
    times."""

    def signal(name: str, unit: str, meaning: str) -> Iterator[Channel]:
        yield Channel(name, unit, f"the motion `{name}`", meaning)
        yield Channel(
            f"{name}_dot", f"{unit}/s", f"the rate of the motion `{name}`", f"rate of {name}"
        )

    for name, symbol in rig.symbols.items():
        for axis in COORDINATES:
            own, unit = f"{name}.{axis}", coordinate_unit(axis)
            key, freedom = f"{axis}_{symbol}", rig.bodies[name].freedom[axis]
            pose, rate = (POSE, RATE) if freedom == "free" else ("", "")
            what = f"{'angle (anticlockwise)' if axis == 'theta' else axis} of the body {name}"
            yield Channel(key, unit, own, what, pose)
            yield Channel(
                rate_channel(key), f"{unit}/s", f"the rate of {own}", f"rate of {what}", rate
            )
            if freedom == "driven":
                yield from signal(own, unit, f"motion that drives {own}")
        what = f"angular momentum of the body {name}"
        owner = f"the angular momentum of the body `{name}`"
        yield Channel(f"angular_momentum_{symbol}", "kg.m2/s", owner, what)
    for name, actuator in rig.actuators.items():
        unit, feed = actuator.effort_unit, actuator.feed_forward
        for coordinate, setpoint in actuator.follows:
            of = f"set-point of {coordinate}" if setpoint != feed else f"signal {setpoint}"
            yield from signal(setpoint, coordinate_unit(coordinate), of)
        if feed is not None:
            yield from signal(feed, unit, f"signal {feed}")
        what = f"effort of the actuator {name} on {actuator.pushes}"
        yield Channel(
            effort_channel(name), unit, f"the effort of the actuator `{name}`", what, EFFORT
        )
    for name in rig.pads:
        what = f"moment of the pad {name} on its base"
        yield Channel(f"M_{name}", "N.m", f"the moment on the pad `{name}`", what)


def measurable(rig: Graph) -> tuple[str, ...]:
    """Channels that a sensor can measure, whose derivatives follow from the bodies' motion: free
    coordinates, their rates in the same order, and the actuators' efforts."""
    every = [*declared(rig)]
    return tuple(one.name for kind in (POSE, RATE, EFFORT) for one in every if one.measures == kind)


def arrays(rig: Graph) -> Iterator[tuple[str, str]]:
    """Key and owner of every other array and dimension of a run's file, and of the channels of
    touch."""
    for name in (*FORMAT, *OF_RIG):
        yield name, f"an array `{name}` of files of runs"
    touch = [f"{{}}.{key}" for key in ("centre", *FORCES)]
    for kind, parts, keys in (
        ("contact", rig.contacts, OF_CONTACT), ("pad", rig.pads, OF_PAD),
        ("body", rig.bodies, OF_BODY), ("actuator", rig.actuators, OF_ACTUATOR),
        ("contact", rig.contacts, touch), ("taxels", rig.taxels, touch),
        ("pad", rig.pads, ("{}.force_x", "{}.force_y")),
        ("body", rig.bodies, [f"{{}}.{key}" for key in ON_BODY]),
    ):  # fmt: skip
        for name in parts:
            for key in keys:
                yield key.format(name), f"`{key.format(name)}` of the {kind} `{name}`"


def junctions(rig: Graph) -> Iterator[tuple[str, str]]:
    """Key and owner of every junction of the multibond graph."""
    yield GROUND, "the ground"
    for name in rig.pads:
        yield f"pad_{name}", f"the pad `{name}`"
    for name in rig.bodies:
        yield name, f"the body `{name}`"
        yield f"{name}_spin", f"the spin of the body `{name}`"


def check_unique(rig: Graph) -> None:
    """Raises `ValueError` where two of a rig's channels, arrays or junctions have one name."""
    channels = ((one.name, one.owner) for one in declared(rig))
    for what, entries in (
        ("junction", junctions(rig)),
        ("channel", (*channels, *arrays(rig))),
    ):
        owners = dict[str, str]()
        for key, owner in entries:
            if (other := owners.setdefault(key, owner)) != owner:
                raise ValueError(
                    f"two would be the {what} `{key}`: {other} and {owner}; call one of them "
                    "otherwise"
                )
