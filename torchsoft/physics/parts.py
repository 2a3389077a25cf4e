"""The parts of a rig beside its pads: rigid bodies, contacts, and actuators with their control
laws."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn

from torchsoft.physics.arguments import number, positive
from torchsoft.physics.contact import SoftContact
from torchsoft.physics.shapes import Shape, parameter
from torchsoft.physics.state import (
    OwnState,
    State,
    StateBlock,
    begin_states,
    law_blocks,
    law_states,
)
from torchsoft.quantity import (
    DerivativeGain,
    EffortLimit,
    Inertia,
    InertiaRatio,
    IntegralGain,
    Lag,
    Mass,
    ProportionalGain,
    Quantity,
)

COORDINATES = ("x", "y", "theta")
"""The coordinates of a body [m, m, rad]."""

Freedom = Literal["free", "driven"] | float
"""A coordinate is free, driven by the reference's signal "body.coordinate", or fixed at a
number."""


class Body(nn.Module):
    """A rigid body: mass [kg], shape (None: nothing touches it), moment of inertia [kg.m2].

    The moment of inertia is a parameter of its own, `own_inertia`, where it is given. It else
    follows mass and shape: it is `inertia_ratio` [1] times that of a body of uniform density, 1 by
    default, about 2 for a ring. Each coordinate is "free", "driven" or a number at which it is
    fixed. Gravity acts along -y where `weighted`. Raises `ValueError` for another coordinate, or a
    body without shape and inertia that may turn.
    """

    def __init__(
        self, mass: Mass = 1.0, shape: Shape | None = None, *, x: Freedom = "free",
        y: Freedom = "free", theta: Freedom = "free", inertia: Inertia | None = None,
        inertia_ratio: InertiaRatio = 1.0, weighted: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        if shape is not None and not isinstance(shape, Shape):
            raise ValueError(f"`shape` must be a Shape, but is {shape!r}")
        self.freedom: dict[str, str] = {}
        for name, value in zip(COORDINATES, (x, y, theta)):
            if isinstance(value, str) and value not in ("free", "driven"):
                raise ValueError(f"`{name}` must be 'free', 'driven' or a number, but is {value!r}")
            self.freedom[name] = value if isinstance(value, str) else "fixed"
        fixed = {k: v for k, v in zip(COORDINATES, (x, y, theta)) if not isinstance(v, str)}
        self.fixed = nn.ParameterDict(
            {
                name: parameter(x if isinstance(x, int) else float(x), name, trained=False)
                for name, x in fixed.items()
            }
        )
        self.mass, self.shape, self.weighted = parameter(mass, "mass"), shape, weighted
        self.own_inertia = None if inertia is None else parameter(inertia, "inertia")
        turns = self.freedom["theta"] == "free" and inertia is None and shape is not None
        self.inertia_ratio = parameter(inertia_ratio, "inertia_ratio") if turns else None
        if number("inertia_ratio", inertia_ratio) != 1.0 and (shape is None or inertia is not None):
            raise ValueError(
                f"`inertia_ratio` must be 1 beside `inertia`, or without a shape, but is "
                f"{inertia_ratio!r}; leave it out"
            )
        if self.freedom["theta"] == "free" and shape is None and inertia is None:
            raise ValueError(
                "a body that may turn needs an `inertia`, or a `shape` to compute it from"
            )

    @property
    def free(self) -> list[int]:
        """Free coordinates, numbers among (x, y, theta)."""
        return [i for i, axis in enumerate(COORDINATES) if self.freedom[axis] == "free"]

    @classmethod
    def uniform(cls, shape: Shape, density: float, depth: float, **given: Any) -> Self:
        """A body of uniform `density` [kg/m3] over its `depth` [m]. Its mass is that of the shape
        as it is now, and a number of its own from then on; its inertia follows the shape. Raises
        `ValueError` for numbers that are not positive."""
        mass = (
            positive("density", density) * positive("depth", depth) * float(shape.area().detach())
        )
        return cls(mass, shape, **given)

    @property
    def inertia(self) -> Tensor:
        """Moment of inertia about the centre of mass [kg.m2]."""
        if self.own_inertia is not None:
            return self.own_inertia
        if self.shape is None:
            return torch.ones_like(self.mass)
        uniform = self.mass * self.shape.gyration()
        return uniform if self.inertia_ratio is None else self.inertia_ratio * uniform

    @property
    def masses(self) -> tuple[Tensor, Tensor, Tensor]:
        """Inertias of the three coordinates: mass twice, moment of inertia."""
        return self.mass, self.mass, self.inertia


class Contact(nn.Module):
    """A pair that may touch: a pad (by name) and a body (by name), with the law at their points.

    A run ends when the body leaves the space over the pad or touches an end of it, unless it
    `may_leave`: it may then be wider than the pad. The sides of a pad are not in contact. A run
    also ends when the body compresses the pad down to its base, or gets behind its surface.
    """

    def __init__(self, pad: str, body: str, law: SoftContact, *, may_leave: bool = False) -> None:
        super().__init__()
        self.pad, self.body, self.law, self.may_leave = pad, body, law, may_leave

    def blocks(self, name: str, points: int) -> list[StateBlock]:
        """States of so many contact points: stretches, and those of the law of friction."""
        units = [one.unit for one in law_states(self.law.friction).values()]
        stretch = StateBlock.of("stretch", name, (points,), "m")
        return [stretch, *law_blocks("friction", name, units, (points,))]


def coordinate_unit(name: str) -> str:
    """SI unit of a coordinate such as "disc.theta"."""
    return "rad" if name.endswith("theta") else "m"


def law_name(law: Callable[..., Tensor]) -> str:
    """Name of a law: that of a function, or that of a module's class."""
    return getattr(law, "__qualname__", type(law).__name__)


class PD(nn.Module):
    """A proportional-derivative law: F = Kp (w - q) + Kd (w' - q') + feed-forward (Eq. 31-34)."""

    def __init__(self, Kp: ProportionalGain, Kd: DerivativeGain) -> None:
        super().__init__()
        self.Kp, self.Kd = parameter(Kp, "Kp"), parameter(Kd, "Kd")

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        return self.Kp * (w - q) + self.Kd * (w_dot - q_dot) + feed_forward


class ReversedPD(PD):
    """The same with the other sign, for a coordinate that falls where the one that is pushed rises:
    a bracket that goes to the right turns a disc under it clockwise. Its feed-forward keeps the
    sign."""

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        return feed_forward - self.Kp * (w - q) - self.Kd * (w_dot - q_dot)


class Integral(nn.Module):
    """A law of one loop with integral action: F + Ki times the integral of the error w - q from the
    start of the run on; of q - w where the gains are `reversed`. Nothing bounds it. Raises
    `ValueError` for a law that has states of its own."""

    states: ClassVar = {"integral": OwnState("q.s")}

    def __init__(self, law: nn.Module, Ki: IntegralGain, *, reversed: bool = False) -> None:
        super().__init__()
        if law_states(law):
            raise ValueError(
                "`law` of integral action must have no states of its own; put the lag around it: "
                "Lagging(Integral(law, Ki), lag)"
            )
        self.law, self.Ki, self.sign = law, parameter(Ki, "Ki"), -1.0 if reversed else 1.0

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor,
        z: Tensor, stage: Tensor | float,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        error = self.sign * (w - q)
        integral = z[..., 0] + stage * error
        return self.law(w, w_dot, feed_forward, q, q_dot) + self.Ki * integral, error[..., None]


NO_LAG = 1e-12
"""Time [s] that is added to a lag, so that there may be none."""


class Lagging(nn.Module):
    """The effort F of a law after a first-order lag, as drives have it: lag F' = law - F. It begins
    with what the law says of the start."""

    def __init__(self, law: nn.Module, lag: Lag) -> None:
        super().__init__()
        self.law, self.lag = law, parameter(lag, "lag")

    @property
    def states(self) -> dict[str, OwnState]:
        states = law_states(self.law)
        several = sum(name.startswith("effort") for name in states)
        return states | {f"effort_{several + 1}" if several else "effort": OwnState("F")}

    def begin(self, *seen: Tensor) -> Tensor:
        """States (..., states) at the start."""
        states = begun(self.law, seen)
        return torch.cat((states, respond(self.law, seen, states)[0][..., None]), -1)

    def forward(self, *given: Any) -> tuple[Tensor, Tensor]:
        *seen, z, stage = given
        wanted, rates = respond(self.law, seen, z[..., :-1], stage)
        rate = (wanted - z[..., -1]) / (self.lag + NO_LAG + stage)
        return z[..., -1] + stage * rate, torch.cat((rates, rate[..., None]), -1)


def respond(
    law: Callable[..., Any], seen: Sequence[Tensor], z: Tensor, stage: Tensor | float = 0.0
) -> tuple[Tensor, Tensor]:
    """Effort of a control law at the end of a stage [s] that begins with its states z (..., n), and
    their rates."""
    return law(*seen, z, stage) if law_states(law) else (law(*seen), z)


def begun(law: Callable[..., Any], seen: Sequence[Tensor]) -> Tensor:
    """States (..., n) that a control law begins with: by its method `begin` of what it sees at the
    start, else by their parameters, else at zero."""
    if law_states(law) and hasattr(law, "begin"):
        return law.begin(*seen)
    return begin_states(law, seen[2].shape)


class Guide(nn.Module):
    """Resistance of a guide to its coordinate's rate v: F = -friction v / sqrt(v^2 + v_0^2) -
    damping v; dry friction is smooth below the speed v_0."""

    resists: ClassVar = True

    def __init__(
        self,
        friction: Annotated[float, Quantity("N, N.m", 0.0, 1e6, "dry friction of the guide")] = 0.0,
        damping: Annotated[
            float, Quantity("N.s/m, N.m.s/rad", 0.0, 1e6, "viscous damping of the guide")
        ] = 0.0,
        v_0: Annotated[
            float, Quantity("m/s, rad/s", 1e-9, 1e3, "rate below which dry friction is smooth")
        ] = 1e-3,
    ) -> None:
        super().__init__()
        self.friction, self.damping = parameter(friction, "friction"), parameter(damping, "damping")
        self.v_0 = parameter(v_0, "v_0", trained=False)

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        return -(self.friction / torch.sqrt(q_dot**2 + self.v_0**2) + self.damping) * q_dot


def weight(mass: Tensor, gravity: Tensor) -> Tensor:
    """A body's weight [N] along y."""
    return -mass * gravity


class Tilt(nn.Module):
    """Change of a body's weight [N] along one `axis` where gravity is turned anticlockwise by a
    `tilt` [rad] from -y; `mass` and `gravity` are the body's and the rig's own parameters."""

    def __init__(self, axis: str, tilt: Tensor, mass: Tensor, gravity: Tensor) -> None:
        super().__init__()
        self.axis, self.tilt, self.mass, self.gravity = axis, tilt, mass, gravity

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        part = torch.sin(self.tilt) if self.axis == "x" else 1 - torch.cos(self.tilt)
        return self.mass * self.gravity * part + 0.0 * q


class Load(nn.Module):
    """A load [N or N.m] that a signal, the feed-forward, gives."""

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        return feed_forward + 0.0 * q


class Actuator(nn.Module):
    """Measures coordinates, such as "disc.x", and pushes one, such as "bracket.x", by a law.

    `law` (set-point, its rate, feed-forward, coordinate, its rate) -> effort (...) [N or N.m] is
    torch code: a `PD`, a function, or any module. `setpoint` and `feed_forward` name signals of the
    reference. A law of several coordinates is given `measures` and `setpoint` as sequences of
    names, and sees them along a last dimension; set-points are those of the first coordinates, in
    their order, and there may be none. Laws with several efforts: `controller`. A module with a
    mapping `states`, of names to `OwnState`, has states of its own, such as an integral: it is
    called with two more arguments, the states z* (..., n) at the start of a stage and the stage's
    length a h [s], and gives the effort and the rates z' (..., n), with the values z* + a h z' that
    act at the end of the stage. The effort saturates at a `limit` [N or N.m], which is not smooth;
    states go on as if it did not. A law that says `resists = True` is a resistance between the
    coordinate that it pushes and the ground: its power is dissipated, that of others supplied.
    `elements` are the graph's names of the elements behind it.
    Raises `ValueError` unless names are given, and for more set-points than coordinates.
    """

    def __init__(
        self, measures: str | Sequence[str], pushes: str, law: Callable[..., Tensor], *,
        setpoint: str | Sequence[str], feed_forward: str | None = None,
        limit: EffortLimit | None = None, elements: tuple[str, ...] = ("C: Kp", "R: Kd"),
    ) -> None:  # fmt: skip
        super().__init__()
        self.measures, self.setpoints = (
            names_of("measures", measures),
            names_of("setpoint", setpoint),
        )
        for name, value in (("pushes", pushes), ("feed_forward", feed_forward or "")):
            if not isinstance(value, str):
                raise ValueError(f"`{name}` of an actuator must be a name, but is {value!r}")
        if not callable(law):
            raise ValueError(f"`law` of an actuator must be a function or a module, but is {law!r}")
        if not self.measures or len(self.setpoints) > len(self.measures):
            raise ValueError(
                f"an actuator measures {len(self.measures)} coordinates and follows "
                f"{len(self.setpoints)} set-points, but must measure one at least, and what is to "
                "follow each set-point"
            )
        self.several = not isinstance(measures, str), not isinstance(setpoint, str)
        self.pushes, self.law, self.feed_forward, self.elements = (
            pushes,
            law,
            feed_forward,
            elements,
        )
        self.limit = None if limit is None else parameter(limit, "limit")

    @property
    def follows(self) -> tuple[tuple[str, str], ...]:
        """Coordinates with the set-points that they are to follow."""
        return tuple(zip(self.measures, self.setpoints))

    @property
    def is_loop(self) -> bool:
        """Whether the actuator is the loop of one coordinate, which follows one set-point."""
        return len(self.measures) == len(self.setpoints) == 1

    @property
    def resists(self) -> bool:
        """Whether the law is a resistance, which takes power out."""
        return getattr(self.law, "resists", False)

    @property
    def measured(self) -> str:
        """The coordinate that follows the first set-point."""
        return self.measures[0]

    @property
    def setpoint(self) -> str:
        """The set-point of a loop. Raises `ValueError` where there are none or several."""
        (name,) = self.setpoints
        return name

    def gain_unit(self, order: int, number: int = 0) -> str:
        """Unit of the effort per measured coordinate `number`, or per its derivative of an `order`:
        1 its rate, -1 its integral."""
        effort, coordinate = self.effort_unit, coordinate_unit(self.measures[number])
        return (f"{effort}/{coordinate}", f"{effort}.s/{coordinate}", f"{effort}/({coordinate}.s)")[
            order
        ]

    @property
    def effort_unit(self) -> str:
        return "N.m" if self.pushes.endswith(".theta") else "N"

    @property
    def inputs(self) -> int:
        """Number of signals and coordinates, with their rates, that the law reads."""
        return 2 * (len(self.reads) + len(self.measures))

    @property
    def states(self) -> dict[str, str]:
        """States that the law has of its own, with their units."""
        units = {"q": coordinate_unit(self.measures[0]), "F": self.effort_unit}
        return {
            name: ".".join(units.get(part, part) for part in one.unit.split("."))
            for name, one in law_states(self.law).items()
        }

    @property
    def reads(self) -> tuple[str, ...]:
        """The signals that the law reads: set-points, then the feed-forward if there is one."""
        return self.setpoints if self.feed_forward is None else (*self.setpoints, self.feed_forward)

    def seen(self, signals: Mapping[str, Tensor], state: State, batch: Sequence[int]) -> Tensor:
        """The law's inputs x (*batch, inputs), of signals by name (*batch, 2) and a state."""
        x = [part.expand(tuple(batch)) for name in self.reads for part in signals[name].unbind(-1)]
        for coordinate in self.measures:
            body, _, axis = coordinate.partition(".")
            i = COORDINATES.index(axis)
            x += state.pose[body][..., i], state.velocity[body][..., i]
        return torch.stack(x, -1)

    def forward(self, x: Tensor) -> Tensor:
        """Effort (...) of x (..., inputs): every set-point, the feed-forward if there is one and
        every coordinate, each with its rate; with the states that the law begins with."""
        return self.response(x, self.begin(x))[0]

    def response(self, x: Tensor, z: Tensor, stage: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """Effort (...) and rates of the law's states (..., states), of x (..., inputs) at the end
        of a stage [s] that begins with the states z (..., states)."""
        effort, rates = respond(self.law, self._arguments(x), z, stage)
        if self.limit is not None:
            effort = torch.maximum(torch.minimum(effort, self.limit), -self.limit)
        return effort, rates

    def begin(self, x: Tensor) -> Tensor:
        """States (..., states) that the law begins with at x (..., inputs)."""
        return begun(self.law, self._arguments(x))

    def _arguments(self, x: Tensor) -> tuple[Tensor, ...]:
        values, rates = x[..., 0::2], x[..., 1::2]
        goals, read = len(self.setpoints), len(self.reads)
        w, w_dot, q, q_dot = (
            part
            for both in (slice(goals), slice(read, None))
            for part in (values[..., both], rates[..., both])
        )
        if not self.several[0]:
            q, q_dot = q[..., 0], q_dot[..., 0]
        if not self.several[1]:
            w, w_dot = w[..., 0], w_dot[..., 0]
        fed = torch.zeros_like(values[..., -1]) if read == goals else values[..., goals]
        return w, w_dot, fed, q, q_dot


def names_of(field: str, given: str | Sequence[str]) -> tuple[str, ...]:
    """One name, or several. Raises `ValueError`."""
    names = (
        (given,)
        if isinstance(given, str)
        else tuple(given)
        if isinstance(given, Sequence)
        else (given,)
    )
    for name in names:
        if not isinstance(name, str):
            raise ValueError(
                f"`{field}` of an actuator must be a name, or a sequence of them, but is {given!r}"
            )
    return names


Gains = Annotated[
    Sequence[Sequence[float]],
    Quantity("N/m, N.m/rad, N.s/m, N.m.s/rad", -1e12, 1e12, "gain of an effort"),
]


class StateFeedback(nn.Module):
    """Efforts K e of the errors e: set-points less coordinates, and their rates; without a
    set-point, less the coordinate.

    `gain` K (k, 2 m) has a row for each effort, and columns for the m coordinates and then their
    rates: a regulator of linear theory. Its entries are scalar parameters, gain_1_1, gain_1_2, ...
    of the first row. Raises `ValueError` for another shape.
    """

    def __init__(self, gain: Gains) -> None:
        super().__init__()
        rows = {len(row) for row in gain}
        if len(rows) != 1 or rows.pop() % 2:
            raise ValueError(
                "a gain has rows of one length, of a number for each coordinate and for each rate"
            )
        self.rows, self.columns = len(gain), len(gain[0])
        for i, row in enumerate(gain, 1):
            for j, one in enumerate(row, 1):
                self.register_parameter(name := f"gain_{i}_{j}", parameter(one, name))

    def matrix(self) -> Tensor:
        """The matrix K (k, 2 m)."""
        entries = [
            getattr(self, f"gain_{i}_{j}")
            for i in range(1, self.rows + 1)
            for j in range(1, self.columns + 1)
        ]
        return torch.stack(entries).unflatten(0, (self.rows, self.columns))

    def forward(self, setpoints: Tensor, state: Tensor) -> Tensor:
        given, actual = setpoints.unflatten(-1, (2, -1)), state.unflatten(-1, (2, -1))
        missing = actual.shape[-1] - given.shape[-1]
        desired = torch.cat((given, torch.zeros_like(actual[..., :missing])), -1)
        return (desired - actual).flatten(-2) @ self.matrix().mT


ORDERS = {"Ki": -1, "Kp": 0, "Kd": 1}
"""Derivatives of the error, -1 its integral, that gains of a loop belong to."""


def gain_unit(law: nn.Module, name: str, users: Sequence[Actuator]) -> str | None:
    """Unit of a gain of a control law by its name in the law, which belongs to some actuators, or
    of the limit of one; None for another number."""
    if isinstance(law, Actuator):
        return law.effort_unit
    if isinstance(law, PD | Integral):
        return users[0].gain_unit(ORDERS[name])
    if not isinstance(law, StateFeedback):
        return None
    row, column = (int(one) - 1 for one in name.split("_")[-2:])
    rate, number = divmod(column, len(users[row].measures))
    return users[row].gain_unit(rate, number)


class OneEffort(nn.Module):
    """One of the efforts of a controller with its feed-forward: a law of several coordinates."""

    def __init__(self, module: nn.Module, number: int) -> None:
        super().__init__()
        self.module, self.number = module, number

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        efforts = self.module(torch.cat((w, w_dot), -1), torch.cat((q, q_dot), -1))
        return efforts[..., self.number] + feed_forward


def controller(
    module: nn.Module, *, measures: Sequence[str], setpoints: Sequence[str],
    pushes: Mapping[str, str], feed_forward: Mapping[str, str] | None = None,
    element: str = "Se: controller",
) -> dict[str, Actuator]:  # fmt: skip
    """Actuators of one control law that sees several coordinates and gives several efforts, by
    their names.

    `module` (set-points, state) -> efforts (..., k) [N or N.m]: set-points (..., 2 s) and state
    (..., 2 m) hold all values and then all rates, of the s signals `setpoints` and of the m
    coordinates that it `measures`, which may be all of all bodies. `pushes` names the actuators and
    the coordinate that each pushes, in the order of the efforts: {"x": "bracket.x"}; the channel of
    the first is then F_x. `feed_forward` names signals that are added to efforts. The module is
    shared: its parameters are those of the first of the actuators, and those of the rig's group if
    it is one (`Rig(groups=)`). Raises `ValueError` for another number of efforts, and the
    errors of `Actuator`.
    """
    several, fed = tuple(measures), dict(feed_forward or {})
    if not isinstance(module, nn.Module):
        raise ValueError(f"`module` of a controller must be a torch module, but is {module!r}")
    if isinstance(measures, str) or isinstance(setpoints, str) or not isinstance(pushes, Mapping):
        raise ValueError(
            "`measures` and `setpoints` of a controller are sequences of names, and `pushes` names "
            "by names"
        )
    if unknown := fed.keys() - pushes.keys():
        raise ValueError(
            f"`feed_forward` names {', '.join(sorted(unknown))}, but `pushes` has "
            f"{', '.join(pushes)}"
        )
    made = {
        name: Actuator(
            several,
            pushed,
            OneEffort(module, i),
            setpoint=tuple(setpoints),
            feed_forward=fed.get(name),
            elements=(element,),
        )
        for i, (name, pushed) in enumerate(pushes.items())
    }
    with torch.no_grad():
        example = (
            torch.zeros(2 * len(names), dtype=torch.float64) for names in (setpoints, measures)
        )
        efforts = module(*example)
    if not isinstance(efforts, Tensor) or efforts.shape != (len(pushes),):
        shown = tuple(efforts.shape) if isinstance(efforts, Tensor) else type(efforts).__name__
        raise ValueError(
            f"the controller gives {shown} for one state, but must give one effort for each of "
            f"{list(pushes)}"
        )
    return made
