"""Contacts of a rig file: laws by name, and which pad touches which body by which law."""

from typing import TYPE_CHECKING

from pydantic import Field

from torchsoft.physics.contact import Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.parts import Contact
from torchsoft.rigs.fields import Group, PartTable, one_of, table_of

if TYPE_CHECKING:
    LawTable = PartTable
else:
    LawTable = table_of(SoftContact, friction=one_of(table_of(SmoothSlip, "smooth"), table_of(Coulomb, "coulomb")))


class ContactTable(Group):
    """What may touch: a pad and a body. What has no contact passes through each other."""

    pad: str = Field(description="name of one of the pads")
    body: str = Field(description="name of one of the bodies, with a shape")
    law: str = Field(description="name of one of the laws")
    may_leave: bool = Field(
        default=False, description="true: the run goes on where the body leaves the space over the pad"
    )

    def build(self, laws: dict[str, SoftContact]) -> Contact:
        return Contact(self.pad, self.body, laws[self.law], may_leave=self.may_leave)
