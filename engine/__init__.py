"""The estimators: what turns frames into maps."""

from mirrorskin.engine.onset import Onset, OnsetSearch, find_onset
from mirrorskin.engine.reconstruct import reconstruct
from mirrorskin.engine.score import Score, score
from mirrorskin.engine.summary import Summary, summarise

__all__ = ["Onset", "OnsetSearch", "Score", "Summary", "find_onset", "reconstruct", "score", "summarise"]
