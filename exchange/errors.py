"""What can go wrong with a scan as a file."""

from protocol.errors import FoveascanError


class ExchangeError(FoveascanError):
    """A file that is no scan we can read, or a scan that a format cannot hold. Names the offending field."""
