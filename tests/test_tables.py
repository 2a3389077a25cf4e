"""Tables: refusals are one sentence that names the field, what was given and what is allowed; files
of TOML are read alike."""

from typing import Annotated, Literal

import pytest
from pydantic import Field, model_validator

from torchsoft.tables import LISTED, InvalidTable, Table, from_toml


class Roll(Table):
    kind: Literal["roll"]
    travel: float = Field(default=1.0, gt=0)


class Press(Table):
    kind: Literal["press"]
    depth: float = 1.0


Motion = Annotated[Roll | Press, Field(discriminator="kind")]


class Run(Table):
    step: float = Field(default=1.0, gt=0, le=10.0)
    count: int = Field(default=1, ge=1)
    checked: bool = False
    motions: Annotated[tuple[Motion, ...], LISTED] = ()
    rolls: dict[str, Roll] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _step_is_not_seven(self) -> "Run":
        if self.step == 7.0:
            raise ValueError("step must not be seven")
        return self


REJECTED = {
    "unknown": ({"steps": 1.0}, "`steps` is not known here; did you mean `step`?"),
    "missing": ({"motions": [{"kind": "roll"}, {}]}, "motions.1.kind is missing"),
    "another kind": (
        {"motions": [{"kind": "hop"}]},
        "motions.0.kind should be one of 'roll', 'press', not 'hop'",
    ),
    "in a kind": (
        {"motions": [{"kind": "roll", "travel": -1}]},
        "motions.0.travel should be greater than 0, not -1",
    ),
    "by name": (
        {"rolls": {"a.b": {"kind": "roll", "travel": "x"}}},
        "rolls.a.b.travel should be a valid number, not 'x'",
    ),
    "several unknown": ({"a": 1, "b": 2}, "`a` is not known here, nor are `b`; known are step"),
    "several": ({"step": -1, "count": 0, "checked": 3, "rolls": {"a": 3}}, "; and 1 more"),
}


@pytest.mark.parametrize("name", REJECTED)
def test_a_rejection_is_one_sentence_that_names_the_field(name, tmp_path):
    tree, message = REJECTED[name]
    for make in (lambda: Run(**tree), lambda: Run.model_validate(tree)):
        with pytest.raises(InvalidTable) as error:
            make()
        assert message in str(error.value)
        assert "\n" not in str(error.value)


def test_a_table_stays_as_it_was_made():
    with pytest.raises(InvalidTable, match=r"^step cannot be set: a table stays as it was made"):
        Run().step = 2.0


def test_a_mark_of_order_and_other_ends_of_lines_are_read(tmp_path):
    path = tmp_path / "run.toml"
    path.write_bytes("\ufeffstep = 2.0 # µ\r\ncount = 3\r\n".encode())
    assert from_toml(path, Run.model_validate) == Run(step=2.0, count=3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"step = '\xff'", "is not a TOML file: 'utf-8' codec"),
        (b"a = " + b"[" * 20_000, "its tables are nested too deeply"),
        (b"a = " + b"9" * 5_000, "is not a TOML file: Exceeds the limit"),
        (b"a = 1\na = 2\n", "is not a TOML file: Cannot overwrite a value"),
        ("step = 1.0".encode("utf-16"), "is not a TOML file"),
        (b"step = -1.0", r"run.toml: step should be greater than 0"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(content, message, tmp_path):
    path = tmp_path / "run.toml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"run\.toml") as error:
        from_toml(path, Run.model_validate)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
