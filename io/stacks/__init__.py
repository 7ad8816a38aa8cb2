"""How the frames of one dataset are fetched."""

from mirrorskin.io.stacks.opening import open_stack
from mirrorskin.io.stacks.picked import Picked
from mirrorskin.io.stacks.stack import Cut, Stack

__all__ = ["Cut", "Picked", "Stack", "open_stack"]
