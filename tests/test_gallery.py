"""Programs of the gallery give the answers that their pictures show."""

import runpy
from pathlib import Path
from typing import Any

import pytest

IDENTIFIED = {
    "materials.rubber.E": 9e5, "materials.rubber.tau": 0.012,
    "laws.steel_on_rubber.friction.mu_s": 0.6,
}  # fmt: skip
"""The truth of what is identified from a file."""

ROOT = Path(__file__).parents[1]
PROGRAMS = sorted((ROOT / "examples" / "gallery").glob("*.py"))
QUICK = (
    "first_run", "own_rig", "rig_from_a_file", "relaxation",
)  # fmt: skip


def found(result: Any, truth: dict[str, float]) -> bool:
    """Whether every interval has the truth in it."""
    return all(result[name].ci95[0] < one < result[name].ci95[1] for name, one in truth.items())


ANSWERS = {
    "first_run": lambda n: abs(float(n["run"]["x_C"][1000]) - 40e-3) < 1e-6,
    "own_rig": lambda n: abs((n["x"][-1] - n["x"][0]).item() - 5e-3) < 1e-4,
    "rig_from_a_file": lambda n: (
        float(n["softer"]["y_ellipse"].min()) < float(n["run"]["y_ellipse"].min())
    ),
    "shapes": lambda n: 0.5 < float(n["run"]["theta"][-1]) < 0.53,
    "fingertips": lambda n: 9.0 < float(n["force"][-1]) < 13.0,
    "relaxation": lambda n: (
        n["found"].terms == 2 and abs(n["found"].values["E"] / 0.5e6 - 1) < 0.01
    ),
    "which_motion": lambda n: n["table"][3, 4] < n["table"][:3, 4].min(),  # mu_k by shaking
    "identify": lambda n: found(n["result"], IDENTIFIED),
    "identify_friction": lambda n: found(n["result"], n["truth"]),
    "plan_a_motion": lambda n: abs(n["run"]["x_C"][-1].item() - 52.3e-3) < 1e-4,
    "train_a_policy": lambda n: n["loss"].item() < 0.05,
    "learn_to_turn": lambda n: max(n["trained"]) < 0.1 < max(n["untrained"]),
    "reduced_model": lambda n: n["score"](n["reduced"], n["other"]).worst < 0.01,
    "finite_strain": lambda n: (
        1.03
        < float(
            n["runs"]["neo_hookean"].force["U"][-1, :, 0].sum()
            / n["runs"]["kelvin_voigt"].force["U"][-1, :, 0].sum()
        )
        < 1.15
    ),
    "energy": lambda n: n["run"].energy_residual_rel < 1e-4,
}


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(p, marks=[] if p.stem in QUICK else pytest.mark.slow, id=p.stem)
        for p in PROGRAMS
    ],
)
def test_a_program_answers_its_question(program, monkeypatch):
    import matplotlib.pyplot as plt

    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    monkeypatch.chdir(program.parent)
    names = runpy.run_path(str(program))
    plt.close("all")
    assert program.stem not in ANSWERS or ANSWERS[program.stem](names)
