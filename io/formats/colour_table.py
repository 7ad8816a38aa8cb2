"""Colour tables of indexed pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.opencv import look_up
from mirrorskin.io.base.types import InputError

_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601


class ColourTable:
    """Conversion of indices to samples, from a table (n, 3) of red, green and blue.

    For a grey table, samples are its values. For a table with increasing brightness, such as the false
    colours of microscopes, samples are the indices. InputError for any other table.
    """

    def __init__(self, name: str, colours: NDArray[np.uint8], dtype: np.dtype[Any] | None = None) -> None:
        self._name, kind = name, dtype or np.dtype(np.uint8)
        self.findings: tuple[Finding, ...] = ()
        if (colours == colours[:, :1]).all():
            self._samples = colours[:, 0].astype(kind)
            return
        used = np.flatnonzero(colours.any(axis=1))[-1] + 1  # programs fill up a table with black
        if np.any(np.diff(colours[:used] @ _LUMA) < 0):
            raise InputError(
                f"{name} has a table of colours that is not a scale of brightness: save it in grey"
            )
        self._samples = np.arange(len(colours)).astype(kind)
        text = "the indices of a colour table are read as samples"
        self.findings = (Finding("colour table", text, warning=False),)

    def look_up(self, indices: NDArray[Any]) -> NDArray[Any]:
        """Return the samples of indices."""
        if indices.max(initial=0) >= len(self._samples):
            raise InputError(
                f"{self._name} is damaged: its table has {len(self._samples)} colours. Copy it again"
            )
        return look_up(self._samples, indices)
