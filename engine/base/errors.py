"""Errors of the engine, in addition to `mirrorskin.io.InputError`."""


class NotConverged(Exception):  # noqa: N818  # its name is a promise to users
    """A solver did not reach its tolerance; the message is one line with the residual and a remedy."""

    exit_code = 1
