"""What can go wrong in the engine besides input that cannot be used."""


class NotConverged(Exception):  # noqa: N818  # its name is a promise to users
    """A solver did not reach its tolerance; the message is one line: how near it came, and what to do."""

    exit_code = 1
