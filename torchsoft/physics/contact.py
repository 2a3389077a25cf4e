"""Contact at one point of a pad's surface: detection, the moving frame, penalty normal force and
stick-slip friction.

Equations of the paper in brackets. Everything else is generated from these functions: the compiled
law with its Jacobian and its derivatives in every parameter. Departures from the paper keep forces
continuous: the normal dashpot carries at most twice what the spring does, so that forces begin at
zero, nothing adheres unless it is told to, and the moving frame follows the point on the body
nearest to the pad's instead of the first one touched. None has a length, a force or a speed of its
own: the law is the same at every load and size.
"""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from torchsoft.physics.arguments import positive
from torchsoft.physics.shapes import Shape, parameter
from torchsoft.physics.state import ages, begin_states, law_states
from torchsoft.quantity import Dashpot, FrictionCoefficient, Quantity, Ratio, Stiffness

SlipLaw = Callable[..., Any]
"""Slip rate |gamma'| >= 0 [m/s] under a trial effort E >= 0 [N], a normal force F_N [N] and the
dashpot R [N.s/m] that the slip relieves, each per reference spacing: a function or an `nn.Module`,
in torch operations. The slip must not take more than the effort, R |gamma'| <= E, and all of it
where nothing presses, R |gamma'| = E at F_N = 0: friction is continuous at touch-down then.

A module with a mapping `states`, of names to `OwnState`, has states of its own at every point:
it is called with two more arguments, the states z* (..., n) at the stage's start and the stage's
length a h [s], and gives the slip rate and the rates z' (..., n) of the states, with the values
z* + a h z' that act at the end of the stage. If it has `ages = True`, its one state is the age of
the contact [s], which starts at touch-down: `SoftContact` then takes care of points that do not
touch, and the law states z' of those that do."""


def slip_of(
    friction: SlipLaw, E: Tensor, F_N: Tensor, R: Tensor, z: Tensor | None = None,
    stage: Tensor | float = 0.0,
) -> tuple[Tensor, Tensor | None]:  # fmt: skip
    """Slip rate of a friction law, and the rates of its states, which begin where none are
    given."""
    states = law_states(friction)
    if not states:
        return friction(E, F_N, R), None
    return friction(E, F_N, R, begin_states(friction, E.shape) if z is None else z, stage)


STEEPEST = 5.0
"""Efforts are tried up to so many normal forces, in search of where slip begins."""

JUMP = 1e-6
"""Part of the normal force that the force of a slip may change by within a rounding of the
effort."""


class Onset(NamedTuple):
    """An effort [N] at which the slip rate jumps, and by how much [m/s]."""

    effort: float
    jump: float


@torch.no_grad()
def sharp_onset(friction: SlipLaw, F_N: float, R: float) -> Onset | None:
    """Where the slip rate of a law jumps under a normal force F_N [N] with the dashpot R [N.s/m];
    None where it does not."""
    dashpot, held = (torch.tensor(x, dtype=torch.float64) for x in (R, F_N))
    rate = lambda E: slip_of(friction, E, held.expand(E.shape), dashpot)[0]
    E = torch.linspace(0.0, STEEPEST * F_N, 2001, dtype=torch.float64)
    at = int(rate(E).diff().abs().argmax())
    low, high = E[at], E[at + 1]
    for _ in range(60):
        middle = 0.5 * (low + high)
        before, here, after = rate(torch.stack((low, middle, high)))
        low, high = (low, middle) if abs(here - before) > abs(after - here) else (middle, high)
    before, after = rate(torch.stack((low, high)))
    jump = float(after - before)
    return None if abs(jump) * R <= JUMP * F_N else Onset(float(high), jump)


class Frame(NamedTuple):
    """The moving frame at points: moment arm d [m], normal n, tangent t (..., 2), penetration g [m]
    (...)."""

    d: Tensor
    n: Tensor
    t: Tensor
    g: Tensor


class ContactState(NamedTuple):
    """Per point, shape (...): forces [N], stretch rate s' and slip rate gamma' [m/s], effort e of
    the tangential elements [N], which is F_T where the point touches, rates z' (..., n) of the
    friction law's own states."""

    F_N: Tensor
    F_T: Tensor
    s_dot: Tensor
    gamma_dot: Tensor
    e: Tensor
    z_dot: Tensor | None = None


def cross(d: Tensor) -> Tensor:
    """z x d, the velocity of the moment arm d (..., 2) under unit spin."""
    return torch.stack((-d[..., 1], d[..., 0]), -1)


def turned(v: Tensor, angle: Tensor) -> Tensor:
    """Vectors (..., 2) turned by an angle (...)."""
    c, s = torch.cos(angle), torch.sin(angle)
    return torch.stack((c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]), -1)


def moving_frame(shape: Shape, d: Tensor, theta: Tensor) -> Frame:
    """Detection and frame (Eq. 1, 3) of points at d (..., 2) [m] from the centre of a body turned
    by theta (...)."""
    if shape.round:
        phi, n = shape(d)
    else:
        phi, m = shape(turned(d, -theta))
        n = turned(m, theta)
    return Frame(d, n, cross(n), -phi)


def normal_force(spring: Tensor, dashpot: Tensor) -> Tensor:
    """F_N [N] of the spring's force S = K_n g while g > 0 and the dashpot's D = R_n g' (Eq. 8, 9):
    S + D on withdrawal, never below zero, and S + D (1 - D^2 / (27 S^2)) on approach, where D
    counts up to 3 S, so that F_N <= 3 S. Not smooth at S = 0 and where a withdrawal ends F_N."""
    share = dashpot / torch.where(spring > 0, spring, 1.0)
    approach, withdrawal = share.clamp(0.0, 3.0), share.clamp(-1.0, 0.0)
    return spring * (1 + withdrawal + approach - approach**3 / 27)


StaticFriction = Annotated[FrictionCoefficient, "static coefficient of friction"]
KineticFriction = Annotated[FrictionCoefficient, "kinetic coefficient of friction, at most mu_s"]
FallingSpeed = Annotated[
    float, Quantity("m/s", 1e-9, 1e3, "slip speed over which mu falls from mu_s to mu_k")
]


class LawPart(nn.Module):
    """A part of a contact law, some of whose numbers may follow from other parts of the rig."""

    matched: tuple[str, ...] = ()
    """Names of these numbers; one that has a parameter has its value."""

    def match(self, source: Any, names: Sequence[str]) -> None:
        """Let numbers follow from a `source`, whose `value` gives them by their names."""
        for name in names:
            self.__dict__.pop(name, None)
            self._parameters[name] = None
        self.source, self.matched = source, tuple(names)

    def __getattr__(self, name: str) -> Any:
        known = self.__dict__
        if name in known.get("matched", ()) and known["_parameters"].get(name) is None:
            return self.source.value(self, name)
        return super().__getattr__(name)

    def prepared(self) -> Self:
        """The same with its numbers as they are now; itself if it has all of them."""
        names = [name for name in self.matched if self._parameters.get(name) is None]
        parts = {key: part.prepared() if isinstance(part, LawPart) else part
                 for key, part in self._modules.items() if key != "source"}  # fmt: skip
        if not names and all(part is self._modules[key] for key, part in parts.items()):
            return self
        out = copy(self)
        values: Any = {name: getattr(self, name) for name in names}
        out._parameters, out._modules, out.matched = self._parameters | values, parts, ()
        return out


class Friction(LawPart):
    """A static and a kinetic coefficient of friction [1]."""

    ordered: ClassVar = ("mu_k", "mu_s")
    """The first must not exceed the second."""

    def __init__(self, mu_s: StaticFriction, mu_k: KineticFriction) -> None:
        super().__init__()
        self.mu_s, self.mu_k = parameter(mu_s, "mu_s"), parameter(mu_k, "mu_k")

    def well_posed(self) -> str:
        """The conflict between the parameters; empty where there is none."""
        mu_s, mu_k = self.mu_s.item(), self.mu_k.item()
        return (
            f"mu_k must not exceed mu_s, but mu_k = {mu_k:g} > mu_s = {mu_s:g}"
            if mu_k > mu_s
            else ""
        )


class SmoothSlip(Friction):
    """The slip element: R |gamma'| = <E - mu(gamma') F_N>+, mu = mu_k + (mu_s - mu_k) / (1 +
    |gamma'| / v_s).

    A quadratic in |gamma'|, with one positive root when E > mu_s F_N. Continuous, not smooth at
    slip onset; continuous only if R >= (mu_s - mu_k) F_N / v_s.

    A pad without mass has one velocity only where its dashpots outweigh the fall of friction with
    slip. With the dashpot `R_pad` of a point of the pad's surface [N.s/m] friction falls no faster
    than that: over (mu_s - mu_k) F_N (1 / R + 1 / R_pad) where this is above v_s.
    """

    def __init__(
        self,
        mu_s: StaticFriction,
        mu_k: KineticFriction,
        v_s: FallingSpeed = 5e-3,
        R_pad: Annotated[
            float,
            Quantity(
                "N.s/m", 1e-9, 1e9,
                "instantaneous dashpot of the pad's surface at a point, which bounds the fall of "
                "friction with slip; no bound without one",
            ),
        ]
        | None = None,
    ) -> None:  # fmt: skip
        super().__init__(mu_s, mu_k)
        self.v_s = parameter(v_s, "v_s")
        self.R_pad = None if R_pad is None else parameter(R_pad, "R_pad", trained=False)

    def at_rest(self) -> Tensor:
        """Static friction [1] at the start of a run."""
        return self.mu_s

    def range(self, F_N: Tensor, R: Tensor) -> Tensor:
        """Slip speed [m/s] over which mu falls under F_N [N]."""
        if self.R_pad is None:
            return self.v_s
        least = (self.mu_s - self.mu_k) * F_N * (1 / R + 1 / self.R_pad)
        return torch.maximum(self.v_s, least)

    def jumps(self, F_N: float, R_t: Tensor, K_t: Tensor) -> str:
        """Why the slip rate jumps under F_N [N] between a dashpot [N.s/m] and a spring [N/m]; empty
        if it does not."""
        over = self.range(torch.tensor(F_N, dtype=torch.float64), R_t)
        falls, damps = ((self.at_rest() - self.mu_k) * F_N / over).item(), R_t.item()
        if damps >= falls:
            return ""
        return (
            f"R_t = {damps:.3g} N.s/m is below (mu_s - mu_k) F_N / v_s = {falls:.3g}; raise v_s or "
            "R_t"
        )

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.slip(E, F_N, R, self.mu_s)

    def slip(self, E: Tensor, F_N: Tensor, R: Tensor, mu_s: Tensor) -> Tensor:
        """Slip rate (...) [m/s] under a static friction mu_s (...) [1]."""
        v_s = self.range(F_N, R)
        b = R * v_s - (E - self.mu_k * F_N)
        c = (v_s * (E - mu_s * F_N)).clamp(min=0.0)
        root = torch.sqrt(b * b + 4 * R * c)
        rising = b >= 0  # two forms of the same root, neither of which cancels
        down = torch.where(rising & (root > 0), b + root, 1.0)
        rate = torch.where(rising, 2 * c / down, (root - b) / (2 * R))
        return torch.where(mu_s * F_N <= E, rate, 0.0)


class Coulomb(Friction):
    """Stick up to mu_s F_N, then mu_k F_N (Eqs. 12-13 of the paper with the force's modulus).

    The spring re-anchors so that the Voigt pair carries just mu_k F_N, |gamma'| = (E - mu_k F_N) /
    R. Discontinuous at slip onset unless mu_s = mu_k: gradients across it are biased, and zero by
    mu_s.
    """

    def jumps(self, F_N: float, R_t: Tensor, K_t: Tensor) -> str:
        """Why the slip rate jumps under F_N [N]; empty if it does not."""
        mu_s, mu_k = self.mu_s.item(), self.mu_k.item()
        if mu_k >= mu_s:
            return ""
        return (
            f"friction falls from mu_s = {mu_s:g} to mu_k = {mu_k:g} at once; let it fall over a "
            "slip speed v_s, as SmoothSlip does, or take mu_k = mu_s"
        )

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return torch.where(self.mu_s * F_N <= E, (E - self.mu_k * F_N) / R, 0.0)


REFERENCE_DEPTH = 1e-4
"""Penetration g_0 [m] at which the normal spring's force is K_n g_0, whatever its power."""

ADHERING_DEPTH = 1e-6
"""Penetration [m] at which half of the adhesion acts, which sets in smoothly."""


ONE_MOMENT = 1e-12
"""Length of a stage [s] up to which it is one moment of a step."""

FADING = 1e-2
"""Time [s] within which the age of a point that has lost contact falls by a factor of e. Steps
resolve it, so that a shorter one makes runs longer."""

NEW, KNOWN = 2.5, 10.0
"""Time since touch-down, in stages, up to which an age is that time, and from which on it follows
from its rate: three quarters of a step, and three steps."""


def touched_down(
    g: Tensor, g_dot: Tensor, age: Tensor, stage: Tensor | float
) -> tuple[Tensor, Tensor]:
    """Which points (...) have just touched down, from 1 to 0 as time passes, and the time since
    then, g / g', in stages (1 where it is 0). Of penetrations g [m] and their rates at the end of a
    stage [s], and ages at its start [s]; old points stay old, however fast their load grows."""
    way = stage * g_dot
    lately = (g > 0) & (g < KNOWN * way) & (age < KNOWN * stage)
    since, aged = (x / torch.where(lately, per, 1.0) for x, per in ((g, way), (age, stage)))
    new = ((KNOWN - torch.maximum(since, aged)) / (KNOWN - NEW)).clamp(max=1.0)
    return torch.where(lately, new, 0.0), torch.where(lately, since, 1.0)


class SoftContact(LawPart):
    """The contact elements of one point, per reference spacing: springs K_n, K_t [N/m], dashpots
    R_n, R_t [N.s/m], and a friction law. `weight` scales them to the length of surface that a point
    stands for. With a `power` m [1] the normal spring's force is K_n g_0 (g / g_0)^m, g_0 being
    0.1 mm. An `adhesion` A [N] pulls with A g / (g + 1 um) while the point touches, and adds to the
    force that friction follows (Derjaguin, Muller and Toporov). Friction is `friction_ratio` [1]
    times that of its law. The age of a contact starts at touch-down, and out of contact it fades
    within 10 ms."""

    def __init__(
        self,
        K_n: Annotated[Stiffness, "normal spring"],
        R_n: Annotated[Dashpot, "normal dashpot"],
        K_t: Annotated[Stiffness, "momentary tangential spring: until the point slips"],
        R_t: Annotated[Dashpot, "tangential dashpot"],
        *,
        friction: SlipLaw,
        node_spacing: Annotated[
            float, Quantity("m", 1e-7, 1.0, "length of surface that the four numbers belong to")
        ] = 1e-3,
        power: Annotated[
            float, Quantity("1", 0.5, 4.0, "power of the normal spring's force; linear without one")
        ]
        | None = None,
        adhesion: Annotated[
            float, Quantity("N", 0.0, 1e3, "pull of a point that touches; none without one")
        ]
        | None = None,
        friction_ratio: Annotated[Ratio, "friction over that of the law; 1 without one"]
        | None = None,
    ) -> None:
        super().__init__()
        self.K_n, self.R_n, self.K_t, self.R_t = (
            parameter(value, name)
            for name, value in (("K_n", K_n), ("R_n", R_n), ("K_t", K_t), ("R_t", R_t))
        )
        self.power, self.adhesion, self.friction_ratio = (
            None if value is None else parameter(value, name)
            for name, value in (
                ("power", power),
                ("adhesion", adhesion),
                ("friction_ratio", friction_ratio),
            )
        )
        if not callable(friction):
            raise ValueError(
                "`friction` must be a function or a module of (effort, normal force, dashpot), "
                f"but is {friction!r}"
            )
        self.node_spacing, self.friction = positive("node_spacing", node_spacing), friction

    def well_posed(self) -> str:
        """Conflict between the parameters; empty where there is none."""
        if self.R_t.item() <= 0:
            return "R_t must be positive, since slip relieves the stretch through the dashpot R_t"
        return ""

    def spring(self, g: Tensor) -> Tensor:
        """Force of the normal spring [N] per reference spacing at penetrations g (...) [m]."""
        depth = g.clamp(min=0.0)
        if self.power is None:
            return self.K_n * depth
        over = torch.where(depth > 0, depth, REFERENCE_DEPTH) / REFERENCE_DEPTH
        return torch.where(
            depth > 0, self.K_n * REFERENCE_DEPTH * torch.exp(self.power * torch.log(over)), 0.0
        )

    def pull(self, g: Tensor) -> Tensor:
        """Adhesive force [N] per reference spacing at penetrations g (...) [m]."""
        depth = g.clamp(min=0.0)
        if self.adhesion is None:
            return torch.zeros_like(depth)
        return self.adhesion * depth / (depth + ADHERING_DEPTH)

    def jumps(self, F_N: float) -> str:
        """Why the slip rate jumps under a normal force F_N [N] per reference spacing: friction
        falls with slip faster than spring and dashpot balance, as the law of friction says, or as
        it does where it says nothing. Empty if it does not."""
        judge = getattr(self.friction, "jumps", None)
        held = F_N if self.friction_ratio is None else self.friction_ratio.item() * F_N
        if judge is not None:
            reason = judge(held, self.R_t, self.K_t)
        elif F_N > 0 and (onset := sharp_onset(self.friction, held, self.R_t.item())):
            reason = (
                f"it jumps by {onset.jump:.3g} m/s at an effort of {onset.effort:.3g} N; let "
                "friction fall steadily with slip, as SmoothSlip does, or take a larger R_t"
            )
        else:
            reason = ""
        return f"slip is not single-valued at a normal force of {F_N:.3g} N: {reason}" * bool(
            reason
        )

    def forward(
        self,
        g: Tensor,
        g_dot: Tensor,
        v_T: Tensor,
        s: Tensor,
        weight: Tensor | float = 1.0,
        stage: Tensor | float = 0.0,
        z: Tensor | None = None,
    ) -> ContactState:
        """Forces and rates from penetration g [m], its rate, sliding speed v_T [m/s] and stretch s
        [m], all (...), and the states z (..., n) of a friction law that has some.

        With `stage` = a h [s] the law at the end of an implicit stage: s is then its s*, and the
        stretch that acts is s* + a h s', which turns the dashpot R_t into R_t + a h K_t and changes
        nothing else.
        """
        R = self.R_t + stage * self.K_t
        spring = self.spring(g)
        F_N = normal_force(spring, self.R_n * g_dot)  # (8), (9)
        slides = torch.where(spring > 0, v_T, 0.0)
        trial = self.K_t * s + R * slides  # (10), (11): the effort if nothing slipped
        one = torch.ones_like(trial)
        sign = torch.where(trial >= 0, one, -one)
        held = F_N if self.friction_ratio is None else self.friction_ratio * F_N
        slip, z_dot = self.slips(sign * trial, held, R, z, stage, g, g_dot)
        gamma_dot = sign * slip  # (12), (13)
        s_dot = slides - gamma_dot
        e = self.K_t * s + R * s_dot
        F_T = torch.where(spring > 0, e, 0.0)
        F_N = F_N if self.adhesion is None else F_N - self.pull(g)
        return ContactState(weight * F_N, weight * F_T, s_dot, gamma_dot, weight * e, z_dot)

    def slips(
        self, E: Tensor, F_N: Tensor, R: Tensor, z: Tensor | None, stage: Tensor | float,
        g: Tensor, g_dot: Tensor,
    ) -> tuple[Tensor, Tensor | None]:  # fmt: skip
        """`slip_of` the law of friction, whose contact ages from touch-down on.

        The rate of an age jumps at touch-down, and a discrete derivative would miss how a parameter
        moves the time of touch-down. In the first steps the law is therefore given the age 0 and
        the time since touch-down, in place of the age and the length of the stage.
        """
        if z is None or not ages(self.friction):
            return slip_of(self.friction, E, F_N, R, z, stage)
        age, stage = z[..., 0], stage + 0.0 * E
        age = torch.where(
            stage <= ONE_MOMENT, age.clamp(min=0.0), age
        )  # interpolation may overshoot
        new, since = touched_down(g, g_dot, age, stage)
        lived, first = 1 + new * (since - 1), age * (1 - new)
        slip, z_dot = self.friction(E, F_N, R, first[..., None], stage * lived)
        lost = torch.where(new > 0, new * age / torch.where(new > 0, stage, 1.0), 0.0)
        touching = lived[..., None] * z_dot - lost[..., None]
        return slip, torch.where((g > 0)[..., None], touching, -z / (FADING + stage)[..., None])

    def dissipated(
        self, at: ContactState, g: Tensor, g_dot: Tensor, weight: Tensor | float
    ) -> tuple[Tensor, Tensor]:
        """Powers [W] that dashpots and slip take out, shape (...), never negative."""
        stored = self.spring(g) if self.adhesion is None else self.spring(g) - self.pull(g)
        return (
            at.F_N - weight * stored
        ) * g_dot + weight * self.R_t * at.s_dot**2, at.e * at.gamma_dot

    def stored(self, g: Tensor, s: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Energies [J] of the normal spring, adhesion included, and of the tangential one, shape
        (...)."""
        m, depth = 1.0 if self.power is None else self.power, g.clamp(min=0.0)
        normal = self.spring(g) * depth / (m + 1)
        if self.adhesion is not None:
            normal = normal - self.adhesion * (
                depth - ADHERING_DEPTH * torch.log1p(depth / ADHERING_DEPTH)
            )
        return weight * normal, 0.5 * weight * self.K_t * s**2


# Laws as the kernels call them. A point's motion is (p, r, theta, u', r', theta'): its place in the
# frame of the pad's base, the body's centre and angle there, and their rates.


class PointLaw(NamedTuple):
    """One point's law: force on the pad f (..., 2) [N] with its moment about the body's centre
    [N.m], in the frame of the pad's base, rates (..., states) of stretch and friction's states,
    F_N and F_T (..., 2) [N], powers of dashpots and of slip [W]."""

    f: Tensor
    moment: Tensor
    rates: Tensor
    force: Tensor
    dashpots: Tensor
    slip: Tensor

    @classmethod
    def of(cls, out: Tensor) -> Self:
        """Parts of the outputs (..., 7 + states) of `interface_law`."""
        return cls(
            out[..., :2], out[..., 2], out[..., 3:-4], out[..., -4:-2], out[..., -2], out[..., -1]
        )


def relative_motion(x: Tensor) -> Tensor:
    """A contact's transformer (..., 12): pose (r, theta) of a body in the frame of a pad's base,
    its rates, and the loads on body and base (3 each) of a wrench (Eq. 16, 18, 19, 35).

    x = (q, q_base, V, V_base, W) (..., 15), W being a force [N] on the pad in the frame of its
    base and its moment about the body's centre [N.m]. Power is conserved: the loads are -T^T W
    with T the derivative of the rates by the velocities.
    """
    q, q_base, V, V_base, W = (x[..., 3 * i : 3 * i + 3] for i in range(5))
    angle = q_base[..., 2]
    r = turned(q[..., :2] - q_base[..., :2], -angle)
    r_dot = turned(V[..., :2] - V_base[..., :2], -angle) - V_base[..., 2:] * cross(r)
    f, force = W[..., :2], turned(W[..., :2], angle)
    moment = W[..., 2:] + r[..., :1] * f[..., 1:] - r[..., 1:2] * f[..., :1]
    turn, turn_rate = (q - q_base)[..., 2:], (V - V_base)[..., 2:]
    return torch.cat((r, turn, r_dot, turn_rate, -force, -W[..., 2:], force, moment), -1)


def point_place(x: Tensor) -> tuple[Tensor, Tensor]:
    """Moment arm d (..., 2) [m] of a point from the body's centre, and the body's angle (...)."""
    return x[..., :2] - x[..., 2:4], x[..., 4]


def interface_law(contact: SoftContact, shape: Shape, x: Tensor) -> Tensor:
    """One point's law at a stage (..., 7 + states), as `PointLaw` has it, of x (..., 12 + states):
    the point's motion (10), its states at the stage's start, its weight and the stage's length."""
    d, theta = point_place(x)
    s, z, weight, stage = x[..., 10], x[..., 11:-2], x[..., -2], x[..., -1]
    frame = moving_frame(shape, d, theta)
    v = x[..., 7:9] + x[..., 9, None] * cross(d) - x[..., 5:7]  # (4)-(7)
    g_dot, v_T = (frame.n * v).sum(-1), (frame.t * v).sum(-1)
    at = contact(frame.g, g_dot, v_T, s, weight, stage, z)
    f = at.F_N[..., None] * frame.n + at.F_T[..., None] * frame.t
    moment = d[..., 0] * f[..., 1] - d[..., 1] * f[..., 0]
    powers = contact.dissipated(at, frame.g, g_dot, weight)
    after = torch.stack((at.F_N, at.F_T, *powers), -1)
    return torch.cat((f, torch.stack((moment, at.s_dot), -1), *state_rates(at), after), -1)


def state_rates(at: ContactState) -> tuple[Tensor, ...]:
    """Rates of the friction law's states, if it has any."""
    return () if at.z_dot is None else (at.z_dot,)


def distance_law(shape: Shape, x: Tensor) -> Tensor:
    """Signed distance (1,) [m] of the point of `interface_law`'s x."""
    return -moving_frame(shape, *point_place(x)).g[None]


def stored_law(contact: SoftContact, x: Tensor) -> Tensor:
    """Energies (2,) [J] of a point's springs, of x = (penetration, stretch, weight)."""
    return torch.stack(contact.stored(*x.unbind(-1)), -1)


def free_law(contact: SoftContact, x: Tensor) -> Tensor:
    """Rates of the states, powers of dashpots and of slip (..., states + 2) away from contact, of x
    = (states at the stage's start, weight, a h)."""
    s, z, weight, stage = x[..., 0], x[..., 1:-2], x[..., -2], x[..., -1]
    outside, rest = torch.full_like(s, -1.0), torch.zeros_like(s)
    at = contact(outside, rest, rest, s, weight, stage, z)
    powers = torch.stack(contact.dissipated(at, outside, rest, weight), -1)
    return torch.cat((at.s_dot[..., None], *state_rates(at), powers), -1)
