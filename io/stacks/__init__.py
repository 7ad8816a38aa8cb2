"""How the frames of one dataset are fetched."""

from mirrorskin.io.stacks.opening import open_stack
from mirrorskin.io.stacks.stack import Cut, Stack

__all__ = ["Cut", "Stack", "open_stack"]
