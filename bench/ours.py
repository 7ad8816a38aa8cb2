"""The engine's own work on a block, as the cases time it."""

from __future__ import annotations

from typing import Protocol

from mirrorskin.bench.harness import Work
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device

OURS = "mirrorskin"


class Estimator(Protocol):
    """What takes in blocks, answers, and can begin anew."""

    device: Device

    def reset(self) -> None:
        """Forget the frames so far."""

    def push(self, block: Block, /) -> None:
        """Take in the next frames."""

    def result(self) -> object:
        """Return the maps."""


def our_works(estimator: Estimator, block: Block) -> dict[str, Work]:
    """Return the works of taking a block in, until the device is done, and of answering as well."""

    def push() -> None:
        estimator.reset()
        estimator.push(block)
        estimator.device.finish()

    def whole() -> object:
        estimator.reset()
        estimator.push(block)
        return estimator.result()

    return {f"{OURS}, push only": push, OURS: whole}
