"""Results of a simulation: times, states, nodal forces, efforts, energies, channels of touch, and
their origin."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import cached_property, wraps
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from torchsoft.display import Film, Shown, amount, suggestion
from torchsoft.physics.channels import Seen, Touch, read, units
from torchsoft.physics.energy import contact_states, stored
from torchsoft.physics.rig import Rig
from torchsoft.physics.setup import Setup
from torchsoft.physics.state import Layout, State
from torchsoft.solve.gradients import Solved, attached, without_gradient
from torchsoft.solve.parameters import independent
from torchsoft.solve.progress import Progress, Stats
from torchsoft.solve.stepper import METHOD, ImplicitStepper
from torchsoft.solve.steps import Followed

if TYPE_CHECKING:  # these take as long to import as all of this package
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

VERSION = version("torchsoft")

V = TypeVar("V")


def later(make: Callable[[Any], V]) -> cached_property[V]:
    """A part of a trajectory that is made when it is first asked for, with a graph if the states
    have one."""

    @wraps(make)
    def made(run: Trajectory) -> V:
        graph = run.y.requires_grad
        apart = independent() if graph else nullcontext()
        with torch.inference_mode(False), torch.set_grad_enabled(graph), apart:
            return make(run)

    return cached_property(made)


class Trajectory(Shown):
    """A run sampled at t (T,) [s]. SI units, every tensor float64 and shaped (T, ...).

    y: flat states (T, size). recorded (T, recorded): all forces, in the order of
    `recorded_slices`, of which `touch` makes its channels, `run["skin.normal.7"]`; both None in a
    run that was loaded. units: of the channels, by key, as far as the rig knows them.

    setup: meshes, outlines, contacts and actuators as they were, for pictures and files; rig: the
    rig of the run, None in a run that was loaded. made_by: the versions, the rig's description and
    the choice of steps.

    knots (steps + 1,): where the steps began and ended [s]; given to another run, that takes the
    same ones.

    sensitivities (T, components, n): derivatives of the state's last `components` by the n
    parameters `wrt`, and along the further directions of the start, where asked for;
    touch_sensitivities: those of channels of touch (T, n), by key.
    """

    t: Tensor
    y: Tensor
    stats: Stats
    layout: Layout
    wrt: tuple[str, ...] = ()
    sensitivities: Tensor | None = None
    touch_sensitivities: dict[str, Tensor]
    recorded: Tensor | None = None
    touch: Touch | None = None
    rig: Rig | None = None
    _out: Progress
    _stepper: ImplicitStepper
    _motion: Followed

    def __init__(self, **known: Any) -> None:
        """A run all of whose parts are known, as those of one in a file."""
        vars(self).update(known)

    @classmethod
    def of(cls, solved: Solved, rows: tuple[Tensor, Tensor] | None = None) -> Trajectory:
        """The run of the `rows` that the stepper has finished, by default with the adjoint of this
        run behind them. What is made of them is made when it is asked for; at once where code of
        users makes it, which may do otherwise later."""
        task, out = solved.task, solved.out
        y, recorded = (part[: out.rows] for part in rows or attached([solved])[0])
        run = cls(
            t=task.t[: out.rows], y=y, recorded=recorded, stats=out.stats, wrt=task.wrt,
            layout=task.stepper.layout, rig=task.rig or task.stepper.rig,
            touch=(touch := Touch(task.stepper.rig)), touch_sensitivities={},
        )  # fmt: skip
        run._out, run._stepper, run._motion = out, task.stepper, task.stepper.followed
        if solved.slopes is not None:
            of_states, of_sums = (part[: out.rows] for part in solved.slopes)
            run.sensitivities = of_states
            of_touch = touch.slopes(task.touch, of_sums, recorded).unbind(1)
            run.touch_sensitivities = dict(zip(task.touch, of_touch))
        if not task.stepper.parameters.model.shared or not run._motion.known:
            run.complete()
        return run

    def complete(self) -> None:
        """Make everything that is to be made, but the states of contact points."""
        for name, part in vars(Trajectory).items():
            if isinstance(part, cached_property) and name != "contact_state":
                getattr(self, name)

    def __getstate__(self) -> dict[str, Any]:
        self.complete()
        _ = self.contact_state
        return {name: part for name, part in vars(self).items() if name[0] != "_"}

    @later
    def state(self) -> State:
        """The states' parts, by name."""
        return self._stepper.rig.unpack(self.y, self._signals)

    @later
    def channels(self) -> dict[str, Tensor]:
        """Series of coordinates, signals, efforts and moments, by key (T,)."""
        return read(Seen(self._stepper.rig, self.state, self._signals, self.recorded))

    @later
    def force(self) -> dict[str, Tensor]:
        """Normal and friction force (T, points, 2) [N] on the points of each contact, along n and t
        of their moving frames."""
        return {k: x.unflatten(-1, (-1, 2)) for k, x in self._recorded_of("contact").items()}

    @later
    def loads(self) -> dict[str, Tensor]:
        """Loads of contacts and pads on each body (T, 3), a force [N] and a moment about its centre
        [N.m], world axes."""
        return self._recorded_of("body")

    @later
    def displacement(self) -> dict[str, Tensor]:
        """Displacements of the nodes of each pad (T, nodes, 2) [m], in its base's frame."""
        rig = self._stepper.rig
        return {name: rig.displacement(name, self.state) for name in rig.pads}

    @later
    def rates(self) -> dict[str, Tensor]:
        """Rates of the displacements of nodal pads (T, nodes, 2 fields) [m/s]."""
        widths, pads = self._stepper.parameters.model.nodal_widths, self._stepper.rig.pads
        parts = torch.from_numpy(self._out.rate[: len(self.t)]).split([*widths.values()], -1)
        return {name: x.unflatten(-1, (pads[name].nodes, -1)) for name, x in zip(widths, parts)}

    @later
    def energy(self) -> dict[str, Tensor]:
        """Stored energies (T,) [J], by name."""
        return stored(self._stepper.rig, self.state, self.displacement)

    @later
    def stored_energy(self) -> Tensor:
        """Sum of the stored energies (T,) [J], without a graph."""
        if self._stepper.parameters.model.nodal_widths:
            return sum(self.energy.values(), torch.zeros_like(self.t)).detach()
        return torch.from_numpy(self._out.stored[: len(self.t)])

    @later
    def dissipated(self) -> dict[str, Tensor]:
        """Energies dissipated since t[0] (T,) [J], by name."""
        return self._integrals("dissipated")

    @later
    def supplied(self) -> dict[str, Tensor]:
        """Energies supplied since t[0] (T,) [J], by name."""
        return self._integrals("supplied")

    @later
    def injected(self) -> Tensor:
        """Positive part of the sources' work since t[0] (T,) [J]."""
        return self._integral("injected", -1)

    @later
    def knots(self) -> Tensor:
        return torch.from_numpy(self._out.knots)

    @later
    def step_choice(self) -> dict[str, Any]:
        """How the steps were chosen."""
        stepper = self._stepper
        if stepper.step is not None or stepper.knots is not None:
            return {"knots" if stepper.step is None else "step_s": stepper.step}
        return {"rtol": stepper.rtol, "atol": stepper.atol}

    @later
    def made_by(self) -> dict[str, Any]:
        made = {"torchsoft": VERSION, "method": METHOD}
        return {**made, **self._stepper.rig.description(), "steps": self.step_choice}

    @later
    def units(self) -> dict[str, str]:
        return units(self._stepper.rig)

    @later
    def setup(self) -> Setup:
        return Setup.of(self._stepper.rig)

    @later
    def contact_state(self) -> dict[str, Tensor]:
        """State of every contact point by contact, int8 (T, points): 0 separated, 1 sticking, 2
        slipping."""
        state = State(*({k: x.detach() for k, x in part.items()} for part in self.state))
        return contact_states(self._stepper.rig, state, self.force, self.rates)

    @later
    def _signals(self) -> Tensor:
        """The signals at the outputs, with their graph where there is one."""
        stepper, known = self._stepper, None
        if not self.y.requires_grad:
            known = self._motion.at(self.t)
        return stepper.rig.follow(self.t, stepper.reference) if known is None else known

    def _recorded_of(self, kind: str) -> dict[str, Tensor]:
        slices, recorded = self._stepper.parameters.model.recorded, self.recorded
        assert recorded is not None
        return {name: recorded[:, here] for (of, name), here in slices.items() if of == kind}

    def _integral(self, name: str, number: int) -> Tensor:
        rows = torch.from_numpy(self._out.integrals)[: len(self.t), number]
        return without_gradient(name, rows, self.y)

    def _integrals(self, kind: str) -> dict[str, Tensor]:
        every = self._stepper.parameters.model.integrals
        return {
            one.name: one.factor * self._integral(one.name, one.number)
            for one in every if one.kind == kind
        }  # fmt: skip

    def __getitem__(self, channel: str) -> Tensor:
        """A channel (T,), by its name or a short one. Raises `KeyError` naming those that are
        there."""
        if channel not in self.channels:
            channel = self.setup.short.get(channel, channel)
        if channel in self.channels:
            return self.channels[channel]
        touch = self.touch
        if touch is not None and self.recorded is not None and channel in touch:
            return touch.force_sums([channel])[0].value(self.recorded)
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
        from torchsoft.solve.netcdf import to_xarray

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
        `torchsoft.solve.vtk.write`."""
        from torchsoft.solve.vtk import write

        return write(self, Path(path), times)

    def to_mcap(self, path: str | Path) -> None:
        """Write the channels as an MCAP log, a message a sample; needs the extra `export`."""
        from torchsoft.solve.mcap import write_log

        write_log(Path(path), self.to_xarray(), {})

    def save(self, path: str | Path) -> None:
        """Write NetCDF with a checksum. The file appears whole or not at all."""
        from torchsoft.solve.netcdf import save

        save(self.to_xarray(), path)

    @staticmethod
    def load(path: str | Path) -> Trajectory:
        """The run that `save` wrote, without its rig. Raises `ValueError` for any other file and
        for one that is damaged, and `OSError`."""
        from torchsoft.solve.netcdf import from_xarray, load

        return from_xarray(load(path), str(path))
