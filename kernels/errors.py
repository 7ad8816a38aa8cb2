"""Errors of the device layer."""


class DeviceError(Exception):
    """A device failed; the message is one line with the reason and the remedy."""

    exit_code = 1


class UnknownDeviceError(DeviceError):
    """No device matches the name."""

    exit_code = 2


class DeviceMemoryError(DeviceError):
    """The device has no memory for a buffer; smaller pieces may still fit."""
