"""How often somebody may be wrong: failures of each address within a while."""

from __future__ import annotations

from collections import OrderedDict, deque
from functools import lru_cache
from ipaddress import IPv6Address, ip_address, ip_network

ADDRESSES_MAX = 4096
IPV6_PREFIX = 64  # who has one address of these has all


class Attempts:
    """Failures by address: `limit` of them within `within_s` lock it until the first of them is so old."""

    def __init__(self, limit: int, within_s: float) -> None:
        self._limit = limit
        self._within_s = within_s
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def is_locked(self, address: str, now_s: float) -> bool:
        """Whether an address has failed too often."""
        failures = self._failures.get(place_of_address(address))
        return failures is not None and len(failures) == self._limit and now_s - failures[0] < self._within_s

    def failed(self, address: str, now_s: float) -> None:
        """Count a failure."""
        place = place_of_address(address)
        self._failures.setdefault(place, deque(maxlen=self._limit)).append(now_s)
        self._failures.move_to_end(place)
        while len(self._failures) > ADDRESSES_MAX:
            self._failures.popitem(last=False)


@lru_cache(maxsize=ADDRESSES_MAX)
def place_of_address(address: str) -> str:
    """What an address counts as: all that one subscriber has of IPv6 are one."""
    try:
        parsed = ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if not isinstance(parsed, IPv6Address):
        return address
    return str(parsed.ipv4_mapped or ip_network((parsed, IPV6_PREFIX), strict=False))
