"""Errors of requests besides bad input, each with its HTTP status."""

from cosim.errors import CosimError


class Refused(CosimError):
    """A request that is not carried out, for a reason that is no fault of the server's."""

    status = 400
    retry_after: int | None = None  # s, after which it may be carried out


class NotFound(Refused):
    """There is nothing of that id or name."""

    status = 404


class Conflict(Refused):
    """It is not in the state that the request needs."""

    status = 409


class Unavailable(Refused):
    """The server is at its limit: later it will do."""

    status = 429
    retry_after = 5
