"""The estimators: what turns frames into maps."""

from mirrorskin.engine.changepoint import ChangePointSearch, find_change_point
from mirrorskin.engine.onset import OnsetSearch, find_onset
from mirrorskin.engine.reconstruct import METHODS, Method, reconstruct
from mirrorskin.engine.score import Score, score
from mirrorskin.engine.search import EVENTS, Event, Onset
from mirrorskin.engine.summary import Summary, summarise

__all__ = [
    "EVENTS",
    "METHODS",
    "ChangePointSearch",
    "Event",
    "Method",
    "Onset",
    "OnsetSearch",
    "Score",
    "Summary",
    "find_change_point",
    "find_onset",
    "reconstruct",
    "score",
    "summarise",
]
