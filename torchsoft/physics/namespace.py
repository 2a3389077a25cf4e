"""Names that follow from a rig's parts: one namespace of channels and arrays of files, one of
junctions. Two of one name would replace each other in silence.
"""

from collections.abc import Iterator

from torchsoft.physics.channels import declared
from torchsoft.physics.graph import Graph
from torchsoft.physics.multibond import GROUND
from torchsoft.physics.names import FORCES, ON_BODY

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


def arrays(rig: Graph) -> Iterator[tuple[str, str]]:
    """Key and owner of every other array and dimension of a run's file, and of the channels of
    touch."""
    for name in (*FORMAT, *OF_RIG):
        yield name, f"an array `{name}` of files of runs"
    for name, symbol in rig.symbols.items():  # of those too that do not turn
        yield f"angular_momentum_{symbol}", f"the angular momentum of the body `{name}`"
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
