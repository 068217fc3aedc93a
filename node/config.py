"""The node's settings: one TOML file, a section for each part, a default, a unit and bounds beside each setting.

A wrong type, an unknown key or a value out of bounds is a ConfigError that names its place ("capture.baud: ...");
nothing is repaired. Each part of the node is handed its own section and sees no other. Bounds are checked where
settings come in, in `load_config`; sections are frozen from then on.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from drivers.address import check_address
from node.sealed import why_shut
from protocol.errors import ConfigError, UsageError

FILE_MAX_BYTES = 65536
DNS_LABEL_MAX_BYTES = 63


def _split_listen(listen: str) -> tuple[str, int]:
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.]+)\]|([^\s:\[\]]+)):([0-9]{1,5})", listen)
    if not match or int(match[3]) > 65535:
        raise ValueError(f"listen: expected HOST:PORT or [IPv6]:PORT, got {listen!r}")
    return match[1] or match[2], int(match[3])


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _require_address(text: str) -> None:
    try:
        ip_address(text)
    except ValueError:
        raise ValueError(f"trusted_proxies: expected an IP address, got {text!r}") from None


class Capture(Struct, frozen=True, forbid_unknown_fields=True):
    """[capture]: the scanner's port."""

    scanner: Annotated[str, Meta(min_length=1, max_length=4096)] | None = None  # address; none: library only
    baud: Annotated[int, Meta(ge=9600, le=12_000_000)] = 3_000_000  # [Bd]; a USB CDC device ignores it
    stale_s: Annotated[float, Meta(ge=0.1, le=60)] = 2.0  # a link quiet for so long is stale
    passes: Annotated[int, Meta(ge=1, le=64)] = 1  # turns that are averaged: noise falls with their square root
    overlap: Annotated[int, Meta(ge=0, le=255)] = 0  # [1/256 turn] seen again at the end, to tell noise and slip
    stride: Annotated[int, Meta(ge=1, le=255)] = 1  # >1: a fast turn with every so many-th column comes first
    apart: bool = False  # range in one turn, texture in another; done anyway where the scanner takes no other
    repair: bool = True  # take spikes out and fill holes of up to 3 cells; a scan keeps what was measured there

    def __post_init__(self) -> None:
        try:
            check_address(self.scanner or "")
        except ValueError as problem:
            raise ValueError(f"scanner: {problem}") from None


class Server(Struct, frozen=True, forbid_unknown_fields=True):
    """[server]: who may connect, and how much of the node one of them may use."""

    listen: Annotated[str, Meta(max_length=300)] = "127.0.0.1:7345"  # HOST:PORT or [IPv6]:PORT; port 0: any free one
    insecure: bool = False  # plain HTTP without login, on loopback only
    certificate: Annotated[str, Meta(min_length=1, max_length=4096)] | None = None  # PEM; none: the node makes its own
    key: Annotated[str, Meta(min_length=1, max_length=4096)] | None = None  # PEM, its key; or "credential:NAME"
    max_clients: Annotated[int, Meta(ge=1, le=4096)] = 64
    trusted_proxies: Annotated[tuple[str, ...], Meta(max_length=16)] = ()  # your addresses, believed for whom they ask
    shared_cache: bool = False  # let a cache of yours keep foveae, for a day at most
    encode_workers: Annotated[int, Meta(ge=1, le=64)] = 2  # threads that plan and encode, and processes

    def __post_init__(self) -> None:
        host, _ = _split_listen(self.listen)
        if self.insecure and not is_loopback(host):
            raise ValueError(f"insecure: without login only loopback is served, not {host}; listen on 127.0.0.1")
        for proxy in self.trusted_proxies:
            _require_address(proxy)
        if self.shared_cache and not self.insecure and not self.trusted_proxies:
            raise ValueError("shared_cache: say which cache may keep scans, by its address in trusted_proxies")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate: a certificate and its key come together; set both, or neither")

    @property
    def host(self) -> str:
        """The address to bind, without brackets."""
        return _split_listen(self.listen)[0]

    @property
    def port(self) -> int:
        """The TCP port to bind; 0 takes any free one."""
        return _split_listen(self.listen)[1]


class Limits(Struct, frozen=True, forbid_unknown_fields=True):
    """[limits]: what one address or one client may take; nobody who looks at scans comes near."""

    connections: Annotated[int, Meta(ge=32, le=65536)] = 512  # of all together, streams among them
    connections_per_address: Annotated[int, Meta(ge=1, le=65536)] = 256
    requests_per_address: Annotated[int, Meta(ge=1, le=4096)] = 64  # in work at once, streams apart
    streams_per_address: Annotated[int, Meta(ge=1, le=4096)] = 32  # so that one does not take all of max_clients
    requests_s_per_address: Annotated[float, Meta(ge=1, le=1e5)] = 500.0  # [1/s], and twice as many at once
    messages_s: Annotated[float, Meta(ge=1, le=1e5)] = 200.0  # [1/s] on one stream, and twice as many at once
    head_s: Annotated[float, Meta(ge=1, le=600)] = 30.0  # [s] a handshake may take, and then the first request's head
    body_s: Annotated[float, Meta(ge=1, le=600)] = 20.0  # [s] a small body may take
    stall_s: Annotated[float, Meta(ge=1, le=3600)] = 60.0  # [s] that nothing goes out to who takes an answer
    keep_s: Annotated[float, Meta(ge=1, le=3600)] = 75.0  # [s] that a connection is kept on which nothing is asked


class Library(Struct, frozen=True, forbid_unknown_fields=True):
    """[library]: where scans are kept, and as what."""

    folder: Annotated[str, Meta(min_length=1, max_length=4096)] = "~/.local/share/foveascan"  # ~ is the service's home
    spheres: bool = True  # keep a sweep of a closed object as a sphere, too

    @property
    def path(self) -> Path:
        """The folder, absolute and without links. Raises ConfigError as `place` does, and while it is shut."""
        place = self.place
        if shut := why_shut(place):
            raise ConfigError("library.folder: " + ": ".join(shut))
        return place

    @property
    def place(self) -> Path:
        """The same, also while there is nothing to be read. Raises ConfigError where it can be no library's.

        What lies sealed is beside what a link points to, so that no way in leads around it.
        """
        try:
            place = Path(os.path.realpath(Path(self.folder).expanduser()))
        except (RuntimeError, ValueError) as problem:  # nobody's home is known; a zero byte
            raise ConfigError(f"library.folder: {problem}; write an absolute path") from problem
        if not place.name:
            raise ConfigError(f"library.folder: {place} cannot be a library: name a folder in it")
        return place


class Retention(Struct, frozen=True, forbid_unknown_fields=True):
    """[retention]: when scans are deleted; never one that is pinned or open. None: for ever."""

    max_age_days: Annotated[float, Meta(ge=1, le=36500)] | None = None  # older scans and interrupted sweeps go
    max_gb: Annotated[float, Meta(ge=0.1, le=1e6)] | None = None  # [GB] where scans take more, the oldest go


class Audit(Struct, frozen=True, forbid_unknown_fields=True):
    """[audit]: the history of who saw, changed, exported and deleted what."""

    max_mb: Annotated[int, Meta(ge=1, le=512)] = 64  # [MB] then the oldest eighth goes; about 5000 entries each

    @property
    def bytes_max(self) -> int:
        """The same in bytes."""
        return self.max_mb * 1_000_000


class FirstView(Struct, frozen=True, forbid_unknown_fields=True):
    """[first_view]: the whole object at once, coarsely."""

    max_bytes: Annotated[int, Meta(ge=1024, le=1 << 20)] = 32768  # coarse grid, coarse texture and headers together


class Planner(Struct, frozen=True, forbid_unknown_fields=True):
    """[planner]: what an update may take."""

    cold_start_bytes_s: Annotated[float, Meta(ge=1e3, le=1e9)] = 1e6  # bandwidth assumed until acknowledgements tell


class Discovery(Struct, frozen=True, forbid_unknown_fields=True):
    """[discovery]: the announcement on the LAN."""

    enabled: bool = True
    name: Annotated[str, Meta(min_length=1)] | None = None  # instance name, at most 63 bytes of UTF-8; none: the host's

    def __post_init__(self) -> None:
        size_bytes = len((self.name or "").encode())
        if size_bytes > DNS_LABEL_MAX_BYTES:
            raise ValueError(f"name: expected at most {DNS_LABEL_MAX_BYTES} bytes of UTF-8, got {size_bytes}")


class Log(Struct, frozen=True, forbid_unknown_fields=True):
    """[log]: what goes to standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"  # and what is worse
    format: Literal["auto", "text", "json"] = "auto"  # auto: with priorities where it goes to systemd's journal


class Config(Struct, frozen=True, forbid_unknown_fields=True):
    """All sections; each part of the node is handed its own."""

    capture: Capture = Capture()
    server: Server = Server()
    limits: Limits = Limits()
    library: Library = Library()
    retention: Retention = Retention()
    audit: Audit = Audit()
    first_view: FirstView = FirstView()
    planner: Planner = Planner()
    discovery: Discovery = Discovery()
    log: Log = Log()


def load_config(path: Path | None = None, overrides: Mapping[str, object] | None = None) -> Config:
    """Settings from a TOML file (none: the defaults), then from `overrides`, which win.

    overrides : {"server.listen": "127.0.0.1:0", ...}, as a command line gives them; None there means "not given".
    Raises ConfigError for a file that cannot be read or is no TOML, and for a setting that is unknown or out of bounds;
    UsageError where an override set it.
    """
    settings = _read_toml(path) if path else {}
    given = {place: value for place, value in (overrides or {}).items() if value is not None}
    for place, value in given.items():
        _set(settings, place, value)
    try:
        return msgspec.convert(settings, Config)
    except msgspec.ValidationError as problem:
        what = _in_our_words(str(problem))
        if what.partition(":")[0] in given:
            raise UsageError(what) from None
        raise ConfigError(f"{path}: {what}" if path else what) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(FILE_MAX_BYTES + 1)
    except OSError as problem:
        raise ConfigError(f"{path}: {problem.strerror}") from problem
    if len(data) > FILE_MAX_BYTES:
        raise ConfigError(f"{path}: longer than {FILE_MAX_BYTES} bytes, so not a configuration of this node")
    try:
        return tomllib.loads(data.decode())
    except (ValueError, RecursionError) as problem:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise ConfigError(f"{path}: not TOML: {problem}") from problem


def _set(settings: dict[str, Any], place: str, value: object) -> None:
    section, _, key = place.partition(".")
    table = settings.setdefault(section, {})
    if isinstance(table, dict):  # else the file is wrong here, and the conversion says so
        table[key] = value


def _in_our_words(problem: str) -> str:
    """A message of msgspec, place first: "Expected `int` <= 9 - at `$.a.b`" becomes "a.b: expected int <= 9"."""
    what, _, at = problem.partition(" - at ")
    where = at.strip("`").removeprefix("$").removeprefix(".")
    if unknown := re.fullmatch("Object contains unknown field `(.*)`", what, re.DOTALL):
        place = ".".join(filter(None, (where, unknown[1])))
        return f"{place}: unknown key; known here: {', '.join(_keys_of(where))}"
    if not what.startswith("Expected"):  # from a __post_init__ above, which names its own key
        return f"{where}.{what}"
    return f"{where}: {what.replace('`object`', 'a table').replace('`', '').replace('Expected', 'expected')}"


def _keys_of(section: str) -> tuple[str, ...]:
    owner = getattr(Config(), section) if section else Config()
    keys: tuple[str, ...] = owner.__struct_fields__
    return keys
