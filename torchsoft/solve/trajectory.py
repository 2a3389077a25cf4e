"""Results of a simulation: times, states, nodal forces, efforts, energies, channels of touch, and
their origin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchsoft.display import Film, Shown, amount, suggestion
from torchsoft.physics.energy import contact_states
from torchsoft.physics.names import FORCES, ON_BODY
from torchsoft.physics.rig import Rig
from torchsoft.physics.setup import Setup
from torchsoft.physics.state import Layout, State

if TYPE_CHECKING:  # these take as long to import as all of this package
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure
from typing import NamedTuple

import numpy as np
from scipy import sparse

from torchsoft.display import enumerated
from torchsoft.solve.kernel.table import Array, Index
from torchsoft.solve.system import independent


@dataclass(frozen=True)
class Stats:
    """Statistics of a run: steps, linear solves (Newton iterations), steps that Newton did not
    solve and that were shortened, steps rejected for their error, and wall time [s]."""

    steps: int
    newton_iterations: int
    failed_steps: int
    refused_steps: int
    wall_s: float

    @property
    def newton_per_step(self) -> float:
        return self.newton_iterations / max(self.steps, 1)


@dataclass(frozen=True, repr=False)
class Trajectory(Shown):
    """A run sampled at t (T,) [s]. SI units, every tensor float64 and shaped (T, ...).

    y: flat states (T, size). channels: measurable or requested series, by key, (T,) each. force:
    normal and friction force (T, points, 2) [N] on the points of each contact, along n and t of
    their moving frames. recorded (T, recorded): all forces, of which `touch` makes its channels,
    `run["skin.normal.7"]`; both None in a run that was loaded. loads: those of contacts and pads on
    each body (T, 3), a force [N] and a moment about its centre [N.m], world axes. displacement: of
    the nodes of each pad (T, nodes, 2) [m], in its base's frame. energy: stored [J]; dissipated,
    supplied and `injected` [J] since t[0].

    units: of the channels, by key, as far as the rig knows them.

    setup: meshes, outlines, contacts and actuators as they were, for pictures and files; rig: the
    rig of the run, None in a run that was loaded.

    knots (steps + 1,): where the steps began and ended [s]; given to another run, that takes the
    same ones.

    sensitivities (T, components, n): derivatives of the state's last `components` by the n
    parameters `wrt`, and along the further directions of the start, where asked for;
    touch_sensitivities: those of channels of touch (T, n), by key.
    """

    t: Tensor
    y: Tensor
    state: State = field(repr=False)
    channels: dict[str, Tensor] = field(repr=False)
    force: dict[str, Tensor] = field(repr=False)
    loads: dict[str, Tensor] = field(repr=False)
    displacement: dict[str, Tensor] = field(repr=False)
    energy: dict[str, Tensor] = field(repr=False)
    dissipated: dict[str, Tensor] = field(repr=False)
    supplied: dict[str, Tensor] = field(repr=False)
    injected: Tensor = field(repr=False)
    stats: Stats
    knots: Tensor = field(repr=False)
    layout: Layout = field(repr=False)
    made_by: dict[str, Any] = field(repr=False)
    wrt: tuple[str, ...] = ()
    sensitivities: Tensor | None = field(default=None, repr=False)
    touch_sensitivities: dict[str, Tensor] = field(default_factory=dict, repr=False)
    units: dict[str, str] = field(default_factory=dict, repr=False)
    setup: Setup = field(default_factory=Setup, repr=False)
    rig: Rig | None = field(default=None, repr=False, compare=False)
    recorded: Tensor | None = field(default=None, repr=False)
    rates: dict[str, Tensor] = field(default_factory=dict, repr=False)
    touch: Touch | None = field(default=None, repr=False)
    known_contact_state: dict[str, Tensor] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def later(cls, rest: Any, **known: Any) -> Trajectory:
        """A run of whose fields only some are known yet; `rest` has the others as attributes, which
        it makes when they are asked for."""
        run = object.__new__(cls)
        vars(run).update(known, known_contact_state=None, _rest=rest)
        return run

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """A field that was not known yet."""
            own = vars(self)
            if name not in type(self).__dataclass_fields__ or "_rest" not in own:
                raise AttributeError(name)
            with (
                torch.inference_mode(False),
                torch.set_grad_enabled(own["y"].requires_grad),
                independent(),
            ):
                return own.setdefault(name, getattr(own["_rest"], name))

    def complete(self) -> None:
        """Make everything that was not known yet."""
        for name in type(self).__dataclass_fields__:
            getattr(self, name)
        vars(self).pop("_rest", None)

    def __getstate__(self) -> dict[str, Any]:
        self.complete()
        return vars(self)

    def __getitem__(self, channel: str) -> Tensor:
        """A channel (T,), by its name or a short one. Raises `KeyError` naming those that are
        there."""
        if channel not in self.channels:
            channel = self.setup.short.get(channel, channel)
        if channel in self.channels:
            return self.channels[channel]
        touch = self.touch
        if touch is not None and self.recorded is not None and channel in touch:
            return touch[channel].value(self.recorded)
        known = suggestion(channel, self.channels, "it has")
        more = "none, since it was loaded, without its rig" if touch is None else touch.shown
        raise KeyError(f"the run has no channel `{channel}`; {known}, and of touch {more}")

    def __contains__(self, channel: object) -> bool:
        if channel not in self.channels:
            channel = self.setup.short.get(str(channel), channel)
        return channel in self.channels or (self.touch is not None and channel in self.touch)

    def __iter__(self) -> Iterator[str]:
        return iter(self.channels)

    def keys(self) -> Sequence[str]:
        """Names of the channels, without those of touch."""
        return list(self.channels)

    def _ipython_key_completions_(self) -> Sequence[str]:
        return self.keys()

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        t, stats = self.t, self.stats
        title = (
            f"Trajectory: {float(t[0]):g} to {float(t[-1]):g} s, {len(t)} samples, "
            f"{len(self.channels)} channels"
        )
        rows = []
        for name, body in self.setup.bodies.items():
            for axis, channel in body.channels.items():
                if body.freedom[axis] != "fixed":
                    x = self[channel].detach()
                    end = amount(float(x[-1]), self.units.get(channel, ""))
                    rows.append((channel, f"{float(x[0]):.4g} to {end}, {axis} of {name}"))
        forces = ", ".join(
            f"{name} {float(F_N.detach().sum()):.3g} N on {int((F_N > 0).sum())} points"
            for name, force in self.force.items()
            for F_N in [force[-1, :, 0]]
        )
        rows.append(("contacts at the end", forces or "none"))
        rows.append(("energy", f"{self.energy_residual_rel:.1e} of what was injected is missing"))
        rows.append(
            (
                "steps",
                f"{stats.steps}, {stats.newton_per_step:.2g} Newton iterations each, "
                f"{stats.wall_s:.2g} s",
            )
        )
        if self.y.requires_grad:
            rows.append(("gradient", "of every channel, by the discrete adjoint"))
        if self.wrt:
            rows.append(("sensitivities", f"by {', '.join(self.wrt)}"))
        return title, rows

    def together(self, *channels: str) -> Tensor:
        """Channels side by side (T, channels)."""
        return torch.stack([self[name] for name in channels], -1)

    @property
    def energy_residual(self) -> Tensor:
        """Stored energy gained, less supplied, plus dissipated (T,) [J]; zero but for the
        integration error."""
        zero = torch.zeros_like(self.t)
        total = sum(self.energy.values(), zero)
        return (
            total
            - total[0]
            - sum(self.supplied.values(), zero)
            + sum(self.dissipated.values(), zero)
        )

    @property
    def energy_residual_rel(self) -> float:
        """Largest energy residual over the energy that the sources injected."""
        scale = self.injected[-1].detach().clamp(min=1e-300)
        return float(self.energy_residual.detach().abs().max() / scale)

    def at(self, time: float) -> int:
        """Index of the sample nearest to `time` [s]. Raises `ValueError` more than half a sample
        outside of the run."""
        first, last = float(self.t[0]), float(self.t[-1])
        beyond = 0.5 * (last - first) / max(len(self.t) - 1, 1)
        if not first - beyond <= time <= last + beyond:
            raise ValueError(
                f"there is nothing at {time:g} s: the run goes from {first:g} to {last:g} s"
            )
        return int((self.t - time).abs().argmin())

    @cached_property
    def contact_state(self) -> dict[str, Tensor]:
        """State of every contact point by contact, int8 (T, points): 0 separated, 1 sticking, 2
        slipping; -1 where a point touches and nobody knows, since the rig's parameters are no
        longer those of the run."""
        if self.known_contact_state is not None:
            return self.known_contact_state
        rig = self.rig
        if rig is not None and rig.description()["parameters"] == self.made_by["parameters"]:
            state = State(*({k: x.detach() for k, x in part.items()} for part in self.state))
            return contact_states(rig, state, self.force, self.rates)
        touching = {name: force[..., 0] > 0 for name, force in self.force.items()}
        return {name: -there.to(torch.int8) for name, there in touching.items()}

    def plot(self, **options: Any) -> Figure:
        """A dashboard of the run as a matplotlib figure; options of
        `torchsoft.plot.dashboard.dashboard`."""
        from torchsoft.plot.dashboard import dashboard

        return dashboard(self, **options)

    def animate(self, path: str | Path, **options: Any) -> Film:
        """Write a video, .mp4 or .gif, or the interactive player, .html, which a notebook shows;
        options of `torchsoft.plot.animation.animate` or `torchsoft.plot.animation.player`."""
        from torchsoft.plot.animation import animate, player

        (player if Path(path).suffix == ".html" else animate)(self, Path(path), **options)
        return Film(Path(path))

    def to_xarray(self) -> xr.Dataset:
        """The run as an xarray Dataset with named dimensions, units, and how it was made."""
        from torchsoft.solve.formats import to_xarray

        return to_xarray(self)

    def to_pandas(self, *, units: bool = False) -> pd.DataFrame:
        """The channels as columns over time [s]; their units are in `attrs`, and with `units` in
        the headings too, as `torchsoft identify` reads them: `x_BODY [m]`."""
        import pandas as pd

        def heading(name: str) -> str:
            unit = "s" if name == "t" else self.units.get(name) or "1"
            return f"{name} [{unit}]" if units else name

        columns = {heading(name): x.detach().numpy() for name, x in self.channels.items()}
        table = pd.DataFrame(columns, index=pd.Index(self.t.numpy(), name=heading("t")))
        table.attrs["units"] = dict(self.units)
        return table

    def to_vtk(self, path: str | Path, times: Sequence[float] | None = None) -> list[Path]:
        """Write the pads for ParaView and meshio: displacements [m], strains, stresses [Pa], one
        .vtu a sample and a .pvd that lists them; the files written. See
        `torchsoft.solve.formats.write`."""
        from torchsoft.solve.formats import write

        return write(self, Path(path), times)

    def to_mcap(self, path: str | Path) -> None:
        """Write the channels as an MCAP log, a message a sample; needs the extra `export`."""
        from torchsoft.solve.formats import write_log

        write_log(Path(path), self.to_xarray(), {})

    def save(self, path: str | Path) -> None:
        """Write NetCDF with a checksum. The file appears whole or not at all."""
        from torchsoft.solve.formats import save

        save(self.to_xarray(), path)

    @staticmethod
    def load(path: str | Path) -> Trajectory:
        """The run that `save` wrote, without its rig. Raises `ValueError` for any other file and
        for one that is damaged, and `OSError`."""
        from torchsoft.solve.formats import read

        return read(path)


class Ledger(NamedTuple):
    """What a run is judged by: all stored energy (T,) [J]; energies dissipated (T, names) and all
    that is supplied (T,), and injected in all [J]; the largest force on a contact point [N];
    largest displacements of the loaded nodes of pads [m]; how its steps were chosen."""

    stored: Array
    names: Sequence[str]
    dissipated: Array
    supplied: Array
    injected: float
    force: float
    displaced: dict[str, float]
    steps: dict[str, Any]

    @classmethod
    def of(cls, run: Trajectory) -> Ledger:
        known = getattr(vars(run).get("_rest"), "ledger", None)
        if known is not None:
            return known
        plain = lambda parts: [part.detach().numpy() for part in parts.values()]
        none = np.zeros(len(run.t))
        force = max((float(x.detach().norm(dim=-1).max()) for x in run.force.values()), default=0.0)
        return cls(
            sum(plain(run.energy), none), [*run.dissipated],
            np.stack(plain(run.dissipated), 1),
            sum(plain(run.supplied), none), float(run.injected[-1].detach()), force, {},
            run.made_by["steps"],
        )  # fmt: skip


def displaced(run: Trajectory, pad: str) -> float:
    """Largest displacement of a pad's nodes [m]."""
    return float(run.displacement[pad].detach().norm(dim=-1).max())


# Channels of touch: recorded forces of a run as read by sensors on pads, under them and at
# bodies.
#
# `NAME.QUANTITY`, in an array `NAME.QUANTITY.NUMBER`: load_x, load_y, load_theta of a body (by
# contacts and pads, world axes), force_x, force_y of a pad (on its base, in the base's axes; its
# moment is the channel M_NAME), normal and shear of a contact's points and of taxels, and the
# centre of their normal forces.


LIGHT = 1e-3
"""Force [N] that a centre of pressure counts besides the normal forces, at coordinate zero: there
it lies without contact, and with 10 N it is off by a ten-thousandth."""


class ForceSum(NamedTuple):
    """A channel: the sum of weight times recorded force, for a centre of pressure over that of
    `over` and `LIGHT`."""

    at: Index
    weight: Array
    over: Array | None = None

    def value(self, recorded: Tensor) -> Tensor:
        """(T,) of the recorded forces (T, recorded)."""
        parts = recorded[:, torch.from_numpy(self.at)]
        total = parts @ torch.from_numpy(self.weight)
        return total if self.over is None else total / self.lower(recorded)

    def lower(self, recorded: Tensor) -> Tensor:
        """Divisor of a centre's moment (T,) [N]."""
        return recorded[:, torch.from_numpy(self.at)] @ torch.from_numpy(self.over) + LIGHT


class Sums(NamedTuple):
    """Sums of recorded forces: number c has the entries from start[c] on."""

    start: Index
    at: Index
    weight: Array


class Touch:
    """The channels of touch of a rig, by name; they are made when they are first asked for."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig

    @cached_property
    def _arrays(self) -> dict[str, tuple[Any, Array]]:
        """Weights (., points) on the normal forces at all points, and coordinates along the pad's
        surface, by the name of a contact or of taxels."""
        rig, first, out = self._rig, dict[str, int](), dict[str, tuple[Any, Array]]()
        places = {name: rig.pads[c.pad].point_coordinates for name, c in rig.contacts.items()}
        count = sum(map(len, places.values()))
        every = sparse.csr_array(sparse.identity(count))
        for name, own in places.items():
            first[name] = sum(len(places[other]) for other in first)
            out[name] = every[first[name] : first[name] + len(own)], own
        for name, taxels in rig.taxels.items():
            own = sparse.csr_array(taxels.weights(rig.pads[taxels.pad]))
            parts = [out[k][0] for k, contact in rig.contacts.items() if contact.pad == taxels.pad]
            none = sparse.csr_array((len(taxels.places), count))
            out[name] = sum((own @ part for part in parts), none), taxels.places
        return out

    @cached_property
    def single(self) -> dict[str, tuple[str, ForceSum]]:
        """Unit and sum of the channels that are in no array."""
        rig, out = self._rig, dict[str, tuple[str, ForceSum]]()
        for name, (weights, places) in self._arrays.items():
            over = np.ones(len(places)) @ weights
            at = np.flatnonzero(over)
            out[f"{name}.centre"] = "m", ForceSum(2 * at, (places @ weights)[at], over[at])
        at = 2 * sum(len(self._arrays[name][1]) for name in rig.contacts)
        names = [
            (key, unit)
            for name in rig.pads
            for key, unit in (
                (f"{name}.force_x", "N"),
                (f"{name}.force_y", "N"),
                (f"M_{name}", "N.m"),
            )
        ] + [
            (f"{name}.{key}", unit)
            for name in rig.bodies
            for key, unit in zip(ON_BODY, ("N", "N", "N.m"))
        ]
        return out | {
            name: (unit, ForceSum(np.array([at + i]), np.ones(1)))
            for i, (name, unit) in enumerate(names)
        }

    @cached_property
    def arrays(self) -> dict[str, int]:
        """Arrays of forces [N], and how many there are in each."""
        sizes = {name: len(places) for name, (_, places) in self._arrays.items()}
        return {f"{name}.{kind}": size for name, size in sizes.items() for kind in FORCES}

    def __iter__(self) -> Iterator[str]:
        yield from self.single
        yield from self.expanded([*self.arrays])

    @property
    def shown(self) -> str:
        """The names, for messages."""
        return enumerated(self)

    def __contains__(self, name: object) -> bool:
        array, _, number = str(name).rpartition(".")
        inside = number.isdecimal() and int(number) < self.arrays.get(array, 0)
        return name in self.single or (inside and str(int(number)) == number)

    def __getitem__(self, name: str) -> ForceSum:
        """Raises `KeyError` naming the channels that there are."""
        if name not in self:
            raise KeyError(f"there is no channel of touch `{name}`, but there are {self.shown}")
        if name in self.single:
            return self.single[name][1]
        owner, kind, number = name.rsplit(".", 2)
        row = self._arrays[owner][0][[int(number)]]
        return ForceSum(2 * row.indices.astype(np.int64) + FORCES.index(kind), row.data)

    def unit(self, name: str) -> str:
        """SI unit of a channel."""
        return self.single[name][0] if name in self.single else "N"

    def expanded(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names, with the channels of an array in the place of its own."""
        numbered = lambda name: [f"{name}.{i}" for i in range(self.arrays.get(name, 0))]
        return tuple(one for name in names for one in numbered(name) or [name])

    def sums(self, names: Sequence[str]) -> Sums:
        """Weights of the channels: each one's sum, and then the divisors of centres."""
        felt = [self[name] for name in names]
        parts = [(one.at, one.weight) for one in felt]
        parts += [(one.at, one.over) for one in felt if one.over is not None]
        none: Any = [np.zeros(0, np.int64)], [np.zeros(0)]
        return Sums(
            np.cumsum([0, *(len(at) for at, _ in parts)]),
            np.concatenate([*(at for at, _ in parts), *none[0]]),
            np.concatenate([*(weight for _, weight in parts), *none[1]]),
        )

    def slopes(self, names: Sequence[str], of_sums: Tensor, recorded: Tensor) -> Tensor:
        """Derivatives (T, channels, n) of the channels from those of their sums (T, sums, n)."""
        out, next_one = of_sums[:, : len(names)].clone(), len(names)
        for i, felt in enumerate(self[name] for name in names):
            if felt.over is not None:
                down = felt.value(recorded)[:, None] * of_sums[:, next_one]
                out[:, i] = (out[:, i] - down) / felt.lower(recorded)[:, None]
                next_one += 1
        return out
