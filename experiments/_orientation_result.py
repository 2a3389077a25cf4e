"""What `orientation.py` asks and what came out: the configuration, the outcomes, and both as a table and as sentences."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from _orientation_cases import DEGREES, Case, Gains, Outcome, Rigid

from torchsoft import Trajectory
from torchsoft.experiment import markdown
from torchsoft.rigs.balance import shown

DISC, KINEMATICS = "disc", "disc, by kinematics"


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/orientation")
    position_mm: float = 0.1  # tolerance of the centre
    angle_deg: float = 0.5  # and of the orientation
    bandwidth: float = 150.0  # of the loops [rad/s]; assumed, for the model has no delay that would limit it
    speeds: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)  # of the disc
    disc_speed: float = 3.0  # at which its friction is varied
    disc_frictions: tuple[float, ...] = (0.8, 0.02, 0.01, 0.005, 0.002, 0.001)  # mu_s; mu_k in proportion
    aspects: tuple[float, ...] = (1.1, 1.3, 2.0)  # of the ellipses
    slipping_aspect: float = 1.3  # of the one whose friction is varied
    frictions: tuple[float, ...] = (0.5, 0.35, 0.32, 0.3, 0.28, 0.25, 0.2)
    box: bool = True  # a square box, corners rounded to half of its half-width
    passes: int = 2  # runs whose efforts are fed forward, one after the other
    rtol: float = 1e-4
    animation: bool = True
    frames: int = 90
    smoke: bool = False  # a size that takes seconds


@dataclass
class Result:
    config: Config
    gains: Gains
    grip: float  # [N]
    mu: float  # coefficient of friction of the rig
    carrying: float  # the coefficient of friction m a / 2 N that carrying the disc asks for at `disc_speed`
    turning: float  # and I alpha / 2 R N, turning it
    slowest: complex = 0j  # the mode of the closed grip that lasts longest [1/s]
    rigid: dict[str, Rigid] = field(default_factory=dict)  # predictions by shape
    alone: dict[str, Outcome] = field(default_factory=dict)  # by shape, by loops alone
    known: dict[str, Outcome] = field(default_factory=dict)  # by shape, with efforts fed forward
    speeds: dict[float, Outcome] = field(default_factory=dict)
    lags: dict[float, tuple[float, float]] = field(default_factory=dict)  # a / w^2 [mm, deg] by speed
    disc_frictions: dict[float, Outcome] = field(default_factory=dict)
    frictions: dict[float, Outcome] = field(default_factory=dict)
    runs: dict[str, tuple[Case, Trajectory]] = field(default_factory=dict)  # for the figures

    def verdict(self, one: Outcome) -> str:
        if one.stopped:
            return "lost"
        return "within" if one.within(self.config.position_mm, self.config.angle_deg) else "beyond"


def angle_of(result: Result, name: str) -> float:
    """The error of theta [deg] that rigid statics predict for the loop alone."""
    return DEGREES * result.rigid[name].effort / result.gains.table["turn_lower"]["Kp"]


def table(result: Result) -> str:
    """Every run in a row."""
    head = ("run", "centre [mm]", "angle [deg]", "at rest [mm]", "[deg]", "friction / normal", "effort [N]", "verdict")
    named: list[tuple[str, Outcome]] = [(name, one) for name, one in result.alone.items()]
    named += [(f"{name}, efforts fed forward", one) for name, one in result.known.items()]
    named += [(f"disc, {speed:g} times as fast", one) for speed, one in result.speeds.items() if speed != 1]
    named += [(f"disc, {result.config.disc_speed:g} times, mu = {mu:g}", x) for mu, x in result.disc_frictions.items()]
    aspect = f"{result.config.slipping_aspect:g}"
    named += [(f"ellipse {aspect}, fed forward, mu = {mu:g}", one) for mu, one in result.frictions.items()]
    rows = [
        (name, f"{x.position_mm:.4f}", f"{x.angle_deg:.3f}", f"{x.rest_mm:.4f}", f"{x.rest_deg:.4f}", f"{x.friction:.3g}",
         f"{x.effort:.3g}", result.verdict(x))
        for name, x in named
    ]  # fmt: skip
    return markdown(head, rows)


def capital(words: str) -> str:
    return words[0].upper() + words[1:]


def fails(result: Result, outcomes: dict[float, Outcome], rising: bool) -> str:
    """Where a sweep leaves the tolerance, in words."""
    order = sorted(outcomes, reverse=not rising)
    bad = next((key for key in order if result.verdict(outcomes[key]) != "within"), None)
    if bad is None:
        return f"within the tolerance in every run, to {order[-1]:g}"
    one, good = outcomes[bad], order[: order.index(bad)]
    lost = next((key for key in order if outcomes[key].stopped), None)
    parts = [f"within the tolerance to {good[-1]:g}"] if good else []
    if not one.stopped:
        parts.append(f"beyond it at {bad:g} ({one.position_mm:.3f} mm and {one.angle_deg:.3f} deg)")
    if lost is not None:
        parts.append(f"lost at {lost:g} ({outcomes[lost].stopped})")
    return ", ".join(parts)


def of_the_disc(result: Result) -> Iterator[str]:
    c, disc, blind = result.config, result.alone[DISC], result.alone[KINEMATICS]
    yield (
        f"Disc, by PD loops of {c.bandwidth:g} rad/s: centre within {disc.position_mm:.4f} mm, orientation within "
        f"{disc.angle_deg:.3f} deg, at rest {disc.rest_mm:.4f} mm and {disc.rest_deg:.4f} deg: {result.verdict(disc)} the "
        f"tolerance of {c.position_mm:g} mm and {c.angle_deg:g} deg. Slowest mode in the grip: {shown(result.slowest)}."
    )
    yield (
        f"Disc, by the kinematics of rigid rolling without a loop on it: {blind.angle_deg:.2f} deg, {blind.rest_deg:.2f} deg "
        f"at rest: {result.verdict(blind)} the tolerance; soft pads do not roll with the disc's radius."
    )
    if result.speeds:
        fastest = max(result.speeds)
        millimetres, degrees = result.lags[fastest]
        yield (
            f"Disc, times as fast: {fails(result, result.speeds, rising=True)}. At {fastest:g} times the inertia of rigid "
            f"parts alone makes {millimetres:.3f} mm and {degrees:.3f} deg (a / w^2), which a higher bandwidth would mend."
        )
    if result.disc_frictions:
        yield (
            f"Disc, {c.disc_speed:g} times as fast, mu: {fails(result, result.disc_frictions, rising=False)}. Its friction "
            f"cone asks for {result.turning:.4f} to be turned and for {result.carrying:.4f} to be carried, but what friction "
            "cannot carry the dents in the pads do."
        )


def of_a_shape(result: Result, name: str) -> str:
    one, asks = result.alone[name], result.rigid[name]
    if one.stopped:
        has = result.mu
        why = (
            f"mu is {has:g}: at rest there no effort on the jaws could hold it"
            if asks.friction > has
            else f"mu is {has:g}"
        )
        return f"{capital(name)}: lost ({one.stopped}). Its friction cone asks for {asks.friction:.3f}, and {why}."
    words = (
        f"{capital(name)}, by loops alone: {one.position_mm:.3f} mm and {one.angle_deg:.2f} deg (rigid statics: "
        f"{angle_of(result, name):.2f} deg), {result.verdict(one)} the tolerance; friction over normal force "
        f"{one.friction:.3f} (rigid: {asks.friction:.3f}), jaws {one.opening_mm:.2f} mm farther apart "
        f"(rigid: {asks.opening_mm:.2f})."
    )
    if name not in result.known:
        return words
    other = result.known[name]
    return (
        f"{words} Efforts fed forward, learned in {result.config.passes} runs: {other.position_mm:.3f} mm and "
        f"{other.angle_deg:.3f} deg, {result.verdict(other)} it."
    )


def sentences(result: Result) -> Iterator[str]:
    """What came out, what failed included."""
    yield from of_the_disc(result)
    yield from (of_a_shape(result, name) for name in result.rigid if name != DISC)
    name = f"ellipse {result.config.slipping_aspect:g}"
    if result.frictions:
        yield (
            f"{capital(name)}, efforts fed forward, mu: {fails(result, result.frictions, rising=False)}. Its friction cone "
            f"asks for {result.rigid[name].friction:.3f}."
        )
