"""Processes of their own, whose environment decides what their device is like."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

from mirrorskin.kernels.errors import DeviceError

_PATIENCE = 600.0  # seconds


def run_process(command: Sequence[str], environment: Mapping[str, str]) -> dict[str, Any]:
    """Run a process with some variables of its own; return the JSON in its last line.

    Raises
    ------
    DeviceError
        It failed; the message is its last line.
    """
    variables = {**os.environ, **environment}
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=_PATIENCE)
    if done.returncode:
        told = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        raise DeviceError(f"a process of the benchmark ended with {done.returncode}: {told}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found
