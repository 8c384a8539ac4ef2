"""Errors of requests besides bad input, each with its HTTP status."""

from cosim.errors import CosimError


class Refused(CosimError):
    """A request that is not carried out, although the server works."""

    status = 400
    retry_after: int | None = None  # s, after which the request may be repeated


class NotFound(Refused):
    """Nothing has that id or name."""

    status = 404


class Conflict(Refused):
    """The request is not possible in the present state."""

    status = 409


class Unavailable(Refused):
    """The server is at its limit; a later request may succeed."""

    status = 429
    retry_after = 5
