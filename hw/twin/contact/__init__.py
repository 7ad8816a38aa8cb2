"""How the sheet lies on the object."""

from mirrorskin.hw.twin.contact.conform import Conform
from mirrorskin.hw.twin.contact.friction import Friction
from mirrorskin.hw.twin.contact.skin import Elastic

__all__ = ["Conform", "Elastic", "Friction"]
