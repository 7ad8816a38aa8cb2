"""What can go wrong on the way to a device."""


class DeviceError(Exception):
    """A device cannot do its work; the message is one line that says why and what to do."""

    exit_code = 1


class UnknownDeviceError(DeviceError):
    """No device answers to the name that was given."""

    exit_code = 2


class DeviceMemoryError(DeviceError):
    """The device has no room for a buffer; smaller pieces may still fit."""
