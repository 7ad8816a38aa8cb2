"""The engine's own work on a block, as the cases time it."""

from __future__ import annotations

from mirrorskin.bench.harness import Work
from mirrorskin.engine.streaming import Estimator, push_block
from mirrorskin.io import Block

OURS = "mirrorskin"


def our_works(estimator: Estimator, block: Block) -> dict[str, Work]:
    """Return the works of taking a block in, until the device is done, and of answering as well."""

    def push() -> None:
        estimator.reset()
        push_block(estimator, block)
        estimator.device.finish()

    def whole() -> object:
        estimator.reset()
        push_block(estimator, block)
        return estimator.result()

    return {f"{OURS}, push only": push, OURS: whole}
