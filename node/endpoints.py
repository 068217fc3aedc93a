"""Every request that the node answers: what it takes, who may make it, what comes back, what the audit log calls it.

The one table of them. Routes are made from it (`route`), `node.auth` enforces its roles, `node.audit_routes` notes its
events, `node.openapi` describes it to programs, and README's table of roles is `roles_table`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from aiohttp import web
from aiohttp.typedefs import Handler
from msgspec import Meta

from exchange.formats import MEDIA_TYPES
from node import bodies as b
from node.audit import Entry, Event
from node.sidecar import Changes, Sidecar
from protocol import pairing
from protocol.quality import FoundAxis

Content = Mapping[str, Any]
"""A body: its media type, and the kind of record in it; bytes: what is no JSON."""

FORMATS = tuple(suffix.removeprefix(".") for suffix in MEDIA_TYPES)
_SCAN = "^(latest|[0-9a-f]{6,32})$"
PARAMETERS: Mapping[str, Any] = {
    "scan": Annotated[str, Meta(pattern=_SCAN, examples=["latest"])],
    "sweep": Annotated[str, Meta(pattern="^[0-9a-f]{1,64}$")],
    "format": Literal[FORMATS],
    "epoch": Annotated[str, Meta(pattern="^[0-9a-f]{8}$")],
    "range": Annotated[str, Meta(pattern="^(-|[0-9]+([.][0-9]+){7,})$")],
    "texture": Annotated[str, Meta(pattern="^(-|[0-9]+([.][0-9]+){8,})$")],
    "name": str,
    "scanner": Annotated[str, Meta(min_length=1, max_length=200)],
}
"""What may stand in a path, by its name there."""


def is_scan(text: str) -> bool:
    """Whether that may name a scan, as "latest" does, and as an id or its beginning."""
    return re.fullmatch(_SCAN, text) is not None


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A request, and what may come of it.

    path : as routes have it, patterns and all.  does : in a few words.  role : the least that may; None: anybody.
    named : what may stand in the path, where that is less than PARAMETERS says.  query : a record.  headers : more
    than every request may have.  takes : the body.
    gives : the answers; None: one without a body.  fails : beside what `statuses` says of all.
    event : what the audit log calls it when it was answered well; None: nothing, or its handler says more.
    """

    method: str
    path: str
    does: str
    named: Mapping[str, Any] = field(default_factory=dict)
    query: Any = None
    headers: Mapping[str, Any] = field(default_factory=dict)
    takes: Content | None = None
    gives: Mapping[int, Content | None] = field(default_factory=dict)
    fails: tuple[int, ...] = ()
    event: Event | None = None
    role: pairing.Role | None = None

    @property
    def parameters(self) -> Mapping[str, Any]:
        """What stands in the path, by its name there."""
        return {name: self.named.get(name, PARAMETERS[name]) for name in re.findall(r"\{(\w+)\}", self.canonical)}

    @property
    def canonical(self) -> str:
        """The path without patterns, as PROTOCOL has it."""
        return web.DynamicResource(self.path).canonical if "{" in self.path else self.path


def _json(kind: Any) -> Content:
    return {"application/json": kind}


FORM = "application/x-www-form-urlencoded"
BINARY: Content = {"application/octet-stream": bytes}
HTML: Content = {"text/html": bytes}
OR_HTML: Content = {**_json(b.Error), **HTML}
WHOLE = {"scan": b.ScanId}  # what is changed is named by its whole id

MAY: tuple[tuple[pairing.Role | None, str, tuple[Endpoint, ...]], ...] = (
    (None, "pair; hear one word of the node's health", (
        Endpoint("GET", "/pair", "a page for a browser: a form for a pairing code", gives={200: HTML}, fails=(409,)),
        Endpoint(
            "POST", "/pair", "the code from that form for a cookie", takes={FORM: b.PairingForm},
            gives={303: None, 400: HTML, 403: OR_HTML, 429: HTML}, fails=(409,),
        ),
        Endpoint(
            "POST", "/v1/pair", "a proof of a code for a token", takes=_json(pairing.PairRequest),
            gives={200: _json(pairing.Paired)}, fails=(400, 403, 409, 429),
        ),
        Endpoint("GET", "/assets/{name}", "a part of the page", gives={200: {"*/*": bytes}, 304: None}),
        Endpoint(
            "GET", "/healthz", "how the node is",
            gives={200: _json(b.HealthSaid), 503: _json(Any)},  # stopping, or too much is asked
        ),
    )),
    ("monitor", "read the numbers, and why health is as it is", (
        Endpoint("GET", "/metrics", "numbers for Prometheus", gives={200: {"text/plain": bytes}}),
    )),
    ("view", "open the page and the stream; read what requests there are", (
        Endpoint(
            "GET", "/", "the page; whoever has no login is sent to /pair",
            gives={200: {**HTML, "text/plain": bytes}, 303: None, 304: None},
        ),
        Endpoint("GET", "/v1/stream", "the stream, a WebSocket", gives={101: None}, fails=(400,)),
        Endpoint("GET", "/openapi.json", "this description", gives={200: _json(Any)}),
    )),
    ("view", "see which scans there are, and one coarsely", (
        Endpoint("GET", "/v1/scans", "every scan", gives={200: _json(tuple[b.ListedScan, ...])}, event="listed"),
        Endpoint("GET", "/v1/scans/{scan}", "one scan", gives={200: _json(b.ScanDetail)}, event="seen"),
        Endpoint(
            "GET", "/v1/scans/{scan}/coarse", "its first view", query=b.CoarseQuery, gives={200: BINARY}, event="seen"
        ),
        Endpoint(
            "GET", "/v1/scans/{scan}/picture", "a picture of its first view",
            gives={200: {"image/webp": bytes}, 204: None}, event="seen",
        ),
    )),
    ("view", "look at places without a stream, or by way of a cache", (
        Endpoint(
            "GET", "/v1/scans/{scan}/fovea", "where a fovea round a place is", query=b.FoveaQuery, gives={303: None}
        ),
        Endpoint(
            "GET", "/v1/scans/{scan}/fovea/{epoch}/{range}/{texture}", "that fovea",
            gives={200: BINARY}, fails=(400, 410), event="seen",
        ),
        Endpoint(
            "GET", "/v1/auth", "whether a cache may hand out what it keeps", headers={"X-Original-URI": str},
            gives={204: None}, event="seen",
        ),
    )),
    ("view", "read what is said of a scan; download it", (
        Endpoint(
            "GET", "/v1/scans/{scan}/sidecar", "what is said of a scan", gives={200: _json(Sidecar)}, event="read"
        ),
        Endpoint(
            "GET", r"/v1/scans/{scan:[^./]+}.{format:" + "|".join(FORMATS).replace(".", r"\.") + "}",
            "a scan as a file", gives={200: dict.fromkeys(MEDIA_TYPES.values(), bytes)}, fails=(422, 507),
            event="exported",
        ),
    )),
    ("view", "see what the node does, and what was cut", (
        Endpoint("GET", "/v1/node", "who the node is and what it does", gives={200: _json(b.NodeStatus)}),
        Endpoint("GET", "/v1/sweeps", "interrupted sweeps", gives={200: _json(tuple[b.ListedSweep, ...])}),
        Endpoint(
            "GET", "/v1/sweeps/{sweep}.npz", "what there is of one", gives={200: BINARY}, fails=(507,),
            event="sweep exported",
        ),
    )),
    ("view", "see where its scanners' axes are", (
        Endpoint("GET", "/v1/axes", "where they are", gives={200: _json(tuple[FoundAxis, ...])}),
    )),
    ("operate", "sweep; go on with a cut sweep, or drop it", (
        Endpoint("POST", "/v1/sweeps", "sweep", gives={202: _json(b.SweepAsked)}, fails=(409,), event="sweep asked"),
        Endpoint(
            "POST", "/v1/sweeps/{sweep}/resume", "go on with one that was cut",
            gives={202: _json(b.ResumedSweep)}, fails=(409,), event="sweep resumed",
        ),
        Endpoint("DELETE", "/v1/sweeps/{sweep}", "drop one", gives={204: None}, event="sweep deleted"),
    )),
    ("operate", "calibrate a scanner's axis; forget it", (
        Endpoint(
            "POST", "/v1/axes", "find an axis", takes=_json(b.AxisWanted), gives={201: _json(FoundAxis)},
            fails=(404, 422, 507), event="axis calibrated",
        ),
        Endpoint("DELETE", "/v1/axes/{scanner}", "forget one", gives={204: None}, fails=(507,), event="axis forgotten"),
    )),
    ("operate", "import a scan; derive one from another", (
        Endpoint(
            "POST", "/v1/scans", "add a scan", takes={"application/zip": bytes},
            gives={200: _json(b.Kept), 201: _json(b.Kept)}, fails=(422, 507), event="imported",
        ),
        Endpoint(
            "POST", "/v1/scans/{scan}/derive", "a scan in another geometry", takes=_json(b.Derivation),
            gives={201: _json(b.Derived)}, fails=(422, 507), event="derived",
        ),
    )),
    ("operate", "rename, pin, annotate, verify, delete a scan", (
        Endpoint(
            "PATCH", "/v1/scans/{scan}/sidecar", "say something of a scan", named=WHOLE,
            headers={"If-Match": Annotated[str, Meta(pattern='^([*]|"[0-9]{1,9}")$')]},
            takes=_json(Annotated[Changes, Meta(extra_json_schema={"minProperties": 1})]),
            gives={200: _json(Sidecar)}, fails=(412, 507), event="changed",
        ),
        Endpoint(
            "POST", "/v1/scans/{scan}/verify", "read every sample", gives={200: _json(b.Verified)}, event="verified"
        ),
        Endpoint(
            "DELETE", "/v1/scans/{scan}", "delete a scan", named=WHOLE, gives={204: None}, fails=(400,), event="deleted"
        ),
    )),
    ("admin", "let in and put out; read who did what, and how the node is kept", (
        Endpoint(
            "GET", "/v1/codes", "pairing codes that wait", gives={200: _json(tuple[b.ListedCode, ...])}, fails=(409,)
        ),
        Endpoint(
            "POST", "/v1/codes", "a pairing code", takes=_json(b.NewCode), gives={201: _json(b.Offered)}, fails=(409,)
        ),
        Endpoint(
            "GET", "/v1/tokens", "who is paired", gives={200: _json(tuple[b.ListedToken, ...])}, fails=(409,)
        ),
        Endpoint("DELETE", "/v1/tokens/{name}", "put somebody out", gives={204: None}, fails=(409,)),
        Endpoint("GET", "/v1/upkeep", "health, disk, certificate, retention", gives={200: _json(b.Upkeep)}),
        Endpoint("GET", "/v1/audit", "who did what", query=b.AuditQuery, gives={200: _json(tuple[Entry, ...])}),
    )),
)  # fmt: skip
"""Role, what it may, as README says it, and the requests for that."""

ENDPOINTS: Mapping[str, Endpoint] = {
    f"{one.method} {one.canonical}": replace(one, role=role) for role, _, endpoints in MAY for one in endpoints
}
"""All of them, by method and path."""


def route(name: str, handler: Handler) -> web.RouteDef:
    """An endpoint of the table, by method and path, with who answers it."""
    endpoint = ENDPOINTS[name]
    return web.RouteDef(endpoint.method, endpoint.path, handler, {})


def endpoint_of(request: web.Request) -> Endpoint | None:
    """What a request asks for; None: nothing that there is."""
    return ENDPOINTS.get(f"{request.method.replace('HEAD', 'GET')} {place_of(request)}")


def place_of(request: web.Request) -> str:
    """Which route a request takes, as the table has it; "" for one that leads nowhere."""
    resource = request.match_info.route.resource
    return resource.canonical if resource else ""


def statuses(endpoint: Endpoint) -> dict[int, Content | None]:
    """Every status that may come of a request, and what comes with it."""
    fails = {403, 429, 503, *endpoint.fails}  # a foreign origin; too much of it
    fails |= {401} if endpoint.role else set()
    fails |= {404} if "{" in endpoint.path else set()
    fails |= {400} if endpoint.query or endpoint.headers or endpoint.takes else set()
    fails |= {408, 413} if endpoint.takes else set()
    return dict(sorted({**dict.fromkeys(fails, _json(b.Error)), **endpoint.gives}.items()))


def roles_table() -> str:
    """The table of README: each role, what it may, and by which requests."""
    rows = ["| role | may | that is, ask |", "|---|---|---|"]
    for role, may, endpoints in MAY:
        asks = ", ".join(f"`{one.method} {one.canonical}`" for one in endpoints)
        rows.append(f"| {role or 'nobody'} | {may} | {asks} |")
    return "\n".join(rows)
