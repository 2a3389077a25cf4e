"""Checks of drawn parameters before anything is simulated: what they are, and whether the rig file
can have the bounds of their distributions."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch

from torchsoft.datasets.distributions import Distribution, in_ratio
from torchsoft.datasets.rig_files import differs, place
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.rigs.initial import reference
from torchsoft.rigs.places import unit
from torchsoft.tables import line, shown

MIDDLE = 0.5
"""Quantile of the other parameters while the bounds of one are tried."""


class Drawn(NamedTuple):
    """The rig file of one kind with its drawn and its fixed parameters. `template` is the rig whose
    parts all trajectories share; messages begin with the table `where`."""

    template: Rig
    file: RigFile
    parameters: Mapping[str, Distribution]
    fixed: Mapping[str, Any]
    where: str

    def check(self, names: Iterable[str]) -> None:
        """Raises `ValueError` for parameters that are not numbers, or impossible together."""
        for name in self.parameters:
            self._check_number(name)
        self._check_ends({*names})

    def _check_number(self, name: str) -> None:
        """Raises `ValueError` for a parameter that is not a number, or a ratio to something that is
        not."""
        parameters = self.parameters
        with at_field(f"{self.where}parameters.{line(name, 80)}"):
            if name in self.fixed:
                raise ValueError("it is in `fixed` as well; leave one of them out")
            _, value, field = place(self.file, name)
            if isinstance(value, int):
                raise ValueError("it must be the same in every trajectory; set it in `fixed`")
            word = isinstance(value, str) and unit(field)
            if not (value is None or isinstance(value, float) or word):
                raise ValueError(f"it is no number, but {shown(value)}")
            if (base := parameters[name].ratio_to) is None:
                return
            with at_field("ratio_to"):
                if base in parameters and (base == name or parameters[base].ratio_to is not None):
                    raise ValueError(f"{line(base, 80)} is a ratio itself")
                of = 1.0 if base in parameters else place(self.file, base).value
                if not isinstance(of, float):
                    raise ValueError(f"{line(base, 80)} is no number, but {shown(of)}")

    def _check_ends(self, names: set[str]) -> None:
        """Raises `ValueError` where the rig file is impossible: as it is; with each bound of the
        distributions with these names, ratios first, since they are in the values of others; the
        other parameters as the file states them but for the ratios that it is in; and with all
        parameters at their medians."""
        parameters, within = self.parameters, f"{self.where}parameters"
        if reason := self._unlike({}):
            raise ValueError(f"{f'{self.where}fixed' if self.where else 'rig'}: {reason}")
        ratios_first = sorted(parameters, key=lambda name: parameters[name].ratio_to is None)
        for name in (name for name in ratios_first if name in names):
            related = {name, parameters[name].ratio_to}
            related |= {one for one in parameters if parameters[one].ratio_to == name}
            moves = place(self.file, name).keys[0] == "motion"
            for where, end in parameters[name].ends(f"{within}.{name}").items():
                values = self._values({name: end})
                own = {one: values[one] for one in related & values.keys()}
                if reason := self._unlike(own, moves):
                    raise ValueError(f"{where} = {end:g}: {reason}")
        if reason := self._unlike(self._values({})):
            raise ValueError(f"{within} in their middle: {reason}")

    def _values(self, given: dict[str, float]) -> dict[str, float]:
        """All parameters, some of them as given and the others at their medians."""
        middle = {name: one.at(MIDDLE) for name, one in self.parameters.items()}
        return in_ratio(self.file, self.parameters, middle | given)

    def _unlike(self, values: Mapping[str, float], moves: bool = False) -> str | None:
        """The reason why the rig file cannot have these values: they are impossible, or change
        something that all trajectories share. `moves` says that they belong to motions only."""
        try:
            file = self.file.override(values)
            rig = self.template if moves else file.assemble()
            none = torch.zeros(3, dtype=torch.float64)
            reference(file, dict.fromkeys(rig.bodies, none), lambda *_: none[0])
        except ValueError as error:
            return f"impossible: {error}"
        change = differs(self.template, rig)
        return change and f"it changes {change}, which all trajectories share; set it in `fixed`"
