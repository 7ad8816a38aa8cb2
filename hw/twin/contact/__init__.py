"""How the sheet lies on the object."""

from mirrorskin.hw.twin.contact.sheet import Sheet

__all__ = ["Sheet"]
