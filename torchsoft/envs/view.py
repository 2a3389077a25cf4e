"""Pictures of an environment with matplotlib."""

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.registry import BackendFilter, backend_registry
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchsoft.plot.scene import Scene, force_scale, instants
from torchsoft.solve.trajectory import Trajectory

ROOM = 0.25
"""Margin around the first picture, over its size."""


class View:
    """The scene of an episode, with the limits and the force scale of its first picture."""

    def __init__(self, run: Trajectory) -> None:
        (first,) = instants(run, [float(run.t[0])])
        self.figure = Figure(figsize=(6.0, 4.8), dpi=100, layout="constrained")
        self.canvas, axes = FigureCanvasAgg(self.figure), self.figure.subplots()
        self.scene = Scene(axes, run.setup, curves=force_scale(run.setup, [first]))
        sides = [np.array(x) for x in self.scene.limits([first])]
        x, y = (side + ROOM * np.diff(side) * [-1, 1] for side in sides)
        axes.set(xlim=x, ylim=y, xlabel="x [mm]", ylabel="y [mm]")
        self.axes, self._window = axes, None

    def picture(self, run: Trajectory) -> NDArray[np.uint8]:
        """RGB (height, width, 3) of the first sample of a run."""
        (instant,) = instants(run, [float(run.t[0])])
        self.scene.show(instant)
        self.axes.set_title(f"t = {instant.time:.3f} s")
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture in a window. Raises `ValueError` where matplotlib's backend has no
        windows."""
        from matplotlib import pyplot

        if matplotlib.get_backend() not in backend_registry.list_builtin(BackendFilter.INTERACTIVE):
            raise ValueError(
                f"`render_mode` 'human' needs a window, which matplotlib's `{pyplot.get_backend()}`"
                " has not; set MPLBACKEND, or take 'rgb_array'"
            )
        if self._window is None:
            self._window = pyplot.figure()
            self._window.figimage(picture, resize=True)
            pyplot.show(block=False)
        self._window.images[0].set_data(picture)
        pyplot.pause(1e-3)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            from matplotlib import pyplot

            pyplot.close(self._window)
            self._window = None
