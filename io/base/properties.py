"""Declarations of numbers that hold for all frames of a recording, and are stated in its rig file.

Rig files and their template, the header of recordings, the layout of files, the metadata of MCAP, ``info``
and the tables of the documentation are derived from the declarations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, dataclass, field
from typing import Any, Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """The declaration of a number of recordings.

    Attributes
    ----------
    of : str
        The table of the rig file: "stage" or "camera". In recordings the number is in the group of the stage
        or the detector.
    unit : str
        Unit in memory and in files.
    text : str
        Description: a phrase without a full stop.
    use : str
        What is computed with it, for the documentation of the rig file.
    short : str
        Comment in the template of the rig file, with the unit.
    kind : str
        What a value in the rig file is, such as "time".
    within : (float, float)
        Limits in the rig file.
    example : str
        Value in the template.
    in_steps : bool
        Whether it holds for captures in steps, too.
    default : float, optional
        Value if it is not stated, of a camera and a stage that nobody characterised.
    """

    of: Literal["stage", "camera"]
    unit: str
    text: str
    use: str
    short: str
    kind: str
    within: tuple[float, float]
    example: str
    in_steps: bool = True
    default: float | None = None

    @property
    def needed(self) -> str:
        """Valid values in the rig file."""
        return f"a {self.kind} from {self.within[0]:g} to {self.within[1]:g} {self.unit}".rstrip()

    def line(self, name: str) -> str:
        """Return its line in the template of the rig file."""
        return f"{f'# {name} = {self.example}':<32}# {self.short}\n"


def stated(**declaration: Any) -> Any:
    """Declare a number in the body of `mirrorskin.io.Header`, by the fields of `Property`."""
    return field(default=None, metadata={"property": Property(**declaration)})


def declared_in(fields: Mapping[str, Field[Any]]) -> dict[str, Property]:
    """Return the declarations among the fields of a dataclass, by name."""
    return {
        name: member.metadata["property"] for name, member in fields.items() if "property" in member.metadata
    }


def attributes_of(properties: Mapping[str, Property]) -> str:
    """Return the lines of a docstring that describe attributes."""
    return "".join(
        f"{name} : float or None\n    {prop.text[0].upper()}{prop.text[1:]}, {prop.unit}.\n"
        for name, prop in properties.items()
    )
