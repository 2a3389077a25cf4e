"""The command `plot`."""

import argparse
from pathlib import Path
from typing import Any

from torchsoft.cli.results import add_command, say

PLOT = """\
Draws a run that `torchsoft run` or Trajectory.save wrote: FILE.png, a dashboard of motions, contact
forces with the friction cone, points that stick and slip, stress and energies. --html writes the
interactive player, one file for any browser that needs no network; --pdf a dashboard for print, as
wide as a page or a column, with --only for some of its panels."""


def add_commands(commands: Any) -> None:
    """Add the command `plot`."""
    one = add_command(commands, "plot", plot, "draw a saved run", PLOT)
    one.add_argument("file", type=Path, metavar="FILE.nc", help="the run")
    one.add_argument("--html", action="store_true", help="write the interactive player")
    one.add_argument("--pdf", action="store_true", help="write a camera-ready dashboard")
    one.add_argument("--vtk", action="store_true", help="write the pads for ParaView")
    one.add_argument("--mcap", action="store_true", help="write the channels as an MCAP log")
    one.add_argument(
        "--width", choices=("page", "column"), default="page", help="of the PDF (%(default)s)"
    )
    one.add_argument("--only", nargs="+", default=(), metavar="PANEL", help="some panels only")
    one.add_argument("--time", type=float, help="instant that is shown [s] (largest force)")
    one.add_argument("--title", default="", help="title (the file's name)")
    one.add_argument("--out", type=Path, help="folder for what is written (the file's)")


def plot(options: argparse.Namespace) -> int:
    """Draw a saved run."""
    from torchsoft.plot.animation import player
    from torchsoft.plot.dashboard import dashboard, panels
    from torchsoft.plot.figures import SIZES, save
    from torchsoft.plot.scene import instants
    from torchsoft.solve.trajectory import Trajectory

    run, title = Trajectory.load(options.file), options.title or options.file.stem
    made = (options.out or options.file.parent) / options.file.with_suffix("").name
    common: dict[str, Any] = {"only": options.only, "time": options.time}
    written = []
    if options.html:
        written.append(made.with_name(f"{made.name}.html"))
        player(run, written[-1], title=title)
    if options.pdf:
        written.append(made.with_name(f"{made.name}.pdf"))
        figure = dashboard(run, look=options.width, **common)
        tall, most = figure.get_figheight(), SIZES[options.width].height
        if tall > most + 1e-6:
            names = panels(run, *instants(run, [float(run.t[0])]))
            say(
                f"the figure is {25.4 * tall:.0f} mm tall, a page {25.4 * most:.0f}: choose panels "
                f"with --only, of {', '.join(names)}"
            )
        save(figure, written[-1])
    if options.vtk:
        listed = made.with_name(f"{made.name}.pvd")
        run.to_vtk(listed, None if options.time is None else [options.time])
        written.append(listed)
    if options.mcap:
        written.append(made.with_name(f"{made.name}.mcap"))
        run.to_mcap(written[-1])
    if not written:
        written.append(made.with_name(f"{made.name}.png"))
        save(dashboard(run, title=title, **common), written[-1])
    say(f"written to {', '.join(map(str, written))}")
    return 0
