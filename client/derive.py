"""Having a node make scans of scans."""

from __future__ import annotations

import aiohttp
import msgspec

from client.discovery import NodeAddress
from client.login import logged_in
from client.rest import ask, checked
from protocol.grid import Geometry

TIMEOUT = aiohttp.ClientTimeout(total=600)


class Derived(msgspec.Struct, frozen=True):
    """A scan that was made of another. scan : its id.  note : how it was made, and what of it is made up."""

    scan: str = msgspec.field(name="id")
    geometry: Geometry
    note: str = ""


async def derive_scan(
    node: NodeAddress | str,
    scan: str,
    geometry: Geometry,
    *,
    caps: bool = False,
    centre_height_mm: float | None = None,
    top: str | None = None,
    bottom: str | None = None,
    tip_deg: float = 90.0,
    token: str | None = None,
) -> Derived:
    """Have a node keep a scan ("latest" or an id) in another geometry, as a scan of its own.

    caps : make up lids over a cylinder's open ends.  centre_height_mm : of a sphere's centre; None: chosen.
    top, bottom : scans of the same object tipped by tip_deg, over its front and over its back.
    Raises what `connect` raises: RequestRefused, with the reason, for a scan that cannot be made so.
    """
    wanted = {
        "geometry": geometry, "caps": caps, "centreHeightMm": centre_height_mm,
        "top": top, "bottom": bottom, "tipDeg": tip_deg,
    }  # fmt: skip
    async with logged_in(node, token) as (url, http):
        said = await ask(http, "POST", f"{url}/v1/scans/{scan}/derive", wanted, TIMEOUT)
    return checked(said, Derived, "the node made a scan and does not say which")
