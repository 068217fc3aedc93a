"""Having a node find where its scanner's axis is, and asking what it knows of that."""

from __future__ import annotations

from urllib.parse import quote

import aiohttp

from client.discovery import NodeAddress
from client.login import logged_in
from client.rest import ask, checked
from protocol.quality import FoundAxis

TIMEOUT = aiohttp.ClientTimeout(total=120)


async def calibrate_axis(
    node: NodeAddress | str, scan: str, diameter_mm: float, *, token: str | None = None
) -> FoundAxis:
    """Find the axis of the scanner that swept a round body of known diameter, and correct its later sweeps for it.

    scan : "latest" or an id. The body must stand off the middle of the table.
    Raises what `connect` raises: RequestRefused, with the reason, for a sweep that does not tell the axis.
    """
    wanted = {"scan": str(scan), "diameterMm": diameter_mm}
    async with logged_in(node, token) as (url, http):
        said = await ask(http, "POST", f"{url}/v1/axes", wanted, TIMEOUT)
    return checked(said, FoundAxis, "the node found an axis and does not say which")


async def known_axes(node: NodeAddress | str, *, token: str | None = None) -> list[FoundAxis]:
    """What a node knows of its scanners' axes, the newest first. Raises what `connect` raises."""
    async with logged_in(node, token) as (url, http):
        said = await ask(http, "GET", f"{url}/v1/axes")
    return checked(said, list[FoundAxis], "the node lists its scanners' axes")


async def forget_axis(node: NodeAddress | str, scanner: str, *, token: str | None = None) -> None:
    """Have a node correct a scanner's sweeps no longer. scanner : its serial number. Raises what `connect` raises."""
    async with logged_in(node, token) as (url, http):
        await ask(http, "DELETE", f"{url}/v1/axes/{quote(scanner, safe='')}")
