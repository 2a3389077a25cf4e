"""
Energy and the multibond graph
==============================

Where does the energy of a stroke go? The model is a multibond graph: what the sources supply is
stored or dissipated, element by element, and the residual is the error of the integration alone.
"""

import torch

from torchsoft import RigFile, excite
from torchsoft.plot.dashboard import dashboard
from torchsoft.plot.diagram import multibond_graph

built = excite(RigFile.ready("paper"), "fast strokes").build()
t = torch.linspace(0, 1.5, 601, dtype=torch.float64)
run = built.run(t)
print(f"injected {1e3 * run.injected[-1]:.1f} mJ, residual {run.energy_residual_rel:.1e} of that")

# the power balance holds bond by bond at any state, not only along a run
with torch.no_grad():
    graph = built.rig.evaluate(t[250], built.rig.unpack(run.y[250]))
    for name, port in graph.ports.items():
        power = 1e3 * float(port.power(graph.flows))
        way = "from" if port.source else "into"
        print(f"{power:+8.3f} mW {way} {name}: {', '.join(port.elements)}")

balance = dashboard(run)
graph_figure = multibond_graph(built.rig)
