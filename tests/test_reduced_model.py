"""The reduced models at smoke size: what is found agrees with mechanics, and with the full model
where it is used."""

import json

import pytest
from test_experiments import experiment


@pytest.mark.slow
def test_reduced_model_smoke(tmp_path):
    module = experiment("reduced_model")
    result = module.run(module.Config(out=tmp_path, smoke=True))
    numbers = json.loads(json.dumps(result, allow_nan=False))
    stick, slip = numbers["stick"], numbers["slip"]
    assert stick["terms"] <= 10
    assert stick["heldout_nrmse"] < 0.02
    assert stick["rolling_radius_mm"]["found"] == pytest.approx(
        stick["rolling_radius_mm"]["expected"], rel=0.03
    )
    found = {(row["equation"], row["term"]): row for row in stick["coefficients"]}
    for term in ("x_Br - 2 x_C", "v_Br - 2 v_C"):
        row = found["v_C", term]
        assert abs(row["error"]) < 0.1
        assert row["interval"][0] < row["value"] < row["interval"][1]
    assert found["v_Br", "F_x"]["value"] == pytest.approx(1 / 0.4065, rel=0.05)
    assert slip["heldout_nrmse"] < 0.1
    fastest = min(slip["by_stroke"], key=lambda row: row["stroke_time_s"])
    assert fastest["slipping"] > 0.5
    assert (
        fastest["nrmse_linear"] > 2 * fastest["nrmse"]
    )  # saturation is what the faster strokes need
    assert "| stick |" in module.table(result)
