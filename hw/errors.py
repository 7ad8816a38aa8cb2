"""What goes wrong while hardware runs."""


class HardwareError(Exception):
    """A stage or a camera failed; the message is one line that says which, how, and what to do."""

    exit_code = 1
