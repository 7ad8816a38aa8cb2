"""Errors of running hardware."""


class HardwareError(Exception):
    """A stage or a camera failed; the message is one line with the device, the fault and the remedy."""

    exit_code = 1
