"""What a controller answers to a line that it refuses."""

from __future__ import annotations


class GrblError(Exception):
    """A line is refused with ``error:N``; see ``doc/csv/error_codes_en_US.csv`` of GRBL 1.1.

    Attributes
    ----------
    code : int
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


class SoftLimitError(Exception):
    """A move would leave the travel that the soft limits allow: ``ALARM:2``."""
