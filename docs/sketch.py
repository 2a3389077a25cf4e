"""Draws `docs/rig.svg`, the labelled sketch of the paper's rig: `python docs/sketch.py`."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

LENGTH, HEIGHT, RADIUS, FACE = 120.0, 4.59, 19.37, 2.18  # of pads, disc and bracket [mm]
CENTRE = 60.0, HEIGHT + RADIUS
BRACKET = 60.0, 2 * HEIGHT + 2 * RADIUS + FACE
PAD, STEEL, LOOP = "#f2c879", "#b9c3cf", "#b03a2e"

plt.rcParams["svg.hashsalt"] = "rig"  # the same bytes every time
figure, axes = plt.subplots(figsize=(9, 3.4), layout="constrained")


def arrow(start, end, colour="black", bend=0.0, style="-|>", line="-"):
    """An arrow from one point to another [mm]."""
    bent = f"arc3,rad={bend}"
    axes.add_patch(
        FancyArrowPatch(
            start, end, arrowstyle=style, connectionstyle=bent, color=colour, linestyle=line,
            mutation_scale=14, linewidth=1.4, shrinkA=0, shrinkB=0, zorder=5,
        )
    )  # fmt: skip


def label(x, y, text, colour="black", **options):
    """A text at a point [mm]."""
    axes.text(x, y, text, color=colour, fontsize=10.5, zorder=6, **options)


axes.add_patch(
    Rectangle((-6, -4), LENGTH + 12, 4, facecolor="white", edgecolor="grey", hatch="///")
)
upper = BRACKET[1] - FACE - HEIGHT
axes.add_patch(Rectangle((0, BRACKET[1] - FACE), LENGTH, 8, facecolor=STEEL, edgecolor="black"))
for base in (0.0, upper):
    axes.add_patch(Rectangle((0, base), LENGTH, HEIGHT, facecolor=PAD, edgecolor="black"))
    for column in range(4, int(LENGTH), 4):
        axes.plot([column] * 2, [base, base + HEIGHT], color="#8a6d3b", linewidth=0.4)
    for row in (1, 2, 3):
        axes.plot([0, LENGTH], [base + row * HEIGHT / 4] * 2, color="#8a6d3b", linewidth=0.4)
axes.add_patch(Circle(CENTRE, RADIUS, facecolor=STEEL, edgecolor="black"))
for point in (CENTRE, BRACKET):
    axes.plot(*point, "ko", markersize=4, zorder=6)

arrow((0, 0), (20, 0))
arrow((0, 0), (0, 20))
label(21.5, -3.4, "x", weight="bold", bbox={"color": "white", "pad": 0.5})
label(1.2, 17, "y", weight="bold")
arrow((CENTRE[0] + 10, CENTRE[1] - 6), (CENTRE[0] + 2, CENTRE[1] + 11), bend=0.45)
anticlockwise = r"anticlockwise is positive: $\theta_C > 0$"
label(CENTRE[0] + 22, CENTRE[1], anticlockwise, va="center")
label(CENTRE[0], CENTRE[1] - 9, "disc C at\n" + r"$(x_C,\ y_C)$", ha="center", va="center")
label(LENGTH + 3, HEIGHT / 2, "lower pad L, bonded to the ground", va="center")
label(LENGTH + 3, upper + HEIGHT / 2, "upper pad U, bonded to the bracket", va="center")
label(LENGTH + 3, BRACKET[1] + 2, r"bracket Br at $(x_{Br},\ y_{Br})$; does not turn", va="center")

arrow((-24, BRACKET[1] + 2), (0, BRACKET[1] + 2), LOOP)
label(
    -26,
    BRACKET[1] + 2,
    "effort_x\nPD loop:\n" + r"$x_C \rightarrow x_d$",
    LOOP,
    ha="right",
    va="center",
)
arrow((CENTRE[0], BRACKET[1] + 24), (CENTRE[0], BRACKET[1] + 6), LOOP, style="<|-|>")
label(
    CENTRE[0] + 3,
    BRACKET[1] + 17,
    "effort_y, positive upwards\n" + r"PD loop: $y_{Br} \rightarrow y_d$, plus F_ff",
    LOOP,
    va="center",
)
arrow(CENTRE, (-34, 44), LOOP, line=":")
label(-16, 27, r"the loop measures $x_C$", LOOP)
label(
    -24,
    -11,
    "Plane strain. Disc and bracket are rigid; the pads are finite elements, all of one depth.",
    "#444444",
)

axes.set(xlim=(-50, 200), ylim=(-14, 75), aspect="equal")
axes.axis("off")
figure.savefig(Path(__file__).with_name("rig.svg"), metadata={"Date": None}, facecolor="white")
