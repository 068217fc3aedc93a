"""`foveascan pair` and `foveascan access`: letting clients in, on the node's machine. Both work while the node runs."""

from __future__ import annotations

import argparse
import json
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from node.audit_command import add_audit_action, note_at_console, print_audit

if TYPE_CHECKING:
    from node.access import Access
    from node.config import Config

ROLES = ("monitor", "view", "operate", "admin")


def add_access_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `pair` and `access`."""
    pair = subparsers.add_parser("pair", help="print a code that lets one client in, on the node's machine")
    pair.add_argument("--name", required=True, help="what the client is to be called: who or where it is")
    roles = "only the node's health; look; also sweep and change; also pair and revoke (view)"
    pair.add_argument("--role", choices=ROLES, default="view", help=roles)
    pair.add_argument("--minutes", type=_minutes, default=10.0, metavar="M", help="how long the code is valid (10)")
    pair.add_argument("--token", action="store_true", help="print a token instead, for a program such as Prometheus")
    _add_common(pair)
    pair.set_defaults(run=run_pair)

    access = subparsers.add_parser("access", help="list who is paired, revoke, and read who did what")
    actions = access.add_subparsers(title="actions", metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="who is paired, oldest first")
    _add_common(listing)
    listing.set_defaults(run=run_list)
    revoke = actions.add_parser("revoke", help="end a login, with what it is doing at this moment")
    revoke.add_argument("name", help="what it was paired as")
    _add_common(revoke)
    revoke.set_defaults(run=run_revoke)
    audit = add_audit_action(actions)
    _add_common(audit)
    audit.set_defaults(run=run_audit)


def run_pair(args: argparse.Namespace) -> int:
    """Print a code and the certificate's fingerprint."""
    import time

    from node.access import access_folder
    from node.tls import certificate_file, certificate_fingerprint
    from protocol.errors import AccessError
    from protocol.pairing import fingerprint_text

    config = _config(args)
    certificate = certificate_file(config.server, access_folder(_library(config)))
    if not certificate.exists():
        raise AccessError("there is no certificate yet: start the node once, without --insecure")
    shown = certificate_fingerprint(certificate)
    access = _access(config)
    replaces = access.awaits(args.name, time.time())
    if args.token:
        token = access.grant(args.role, args.name, time.time())
        _tell_replaced(args.name, replaces)
        note_at_console(config, "paired", what=f"{args.name}: {args.role}")
        said = {"token": token, "fingerprint": shown, "name": args.name, "role": args.role}
        print(json.dumps(said) if args.json else token, flush=True)
        return 0
    code = access.offer(args.role, args.name, time.time(), 60 * args.minutes)
    _tell_replaced(args.name, replaces)
    note_at_console(config, "code offered", what=f"{args.name}: {args.role}")
    said = {"code": code, "fingerprint": shown, "name": args.name, "role": args.role, "minutes": args.minutes}
    lines = [
        f"code         {code}   for {args.name}, role {args.role}, valid {args.minutes:g} minutes, once",
        f"fingerprint  {fingerprint_text(shown)}",
        f"In Python or a shell there: foveascan join {code}",
        "In a browser: open the node's address, compare the fingerprint with what the browser shows, type the code.",
    ]
    print(json.dumps(said) if args.json else "\n".join(lines), flush=True)
    return 0


def _tell_replaced(name: str, replaces: bool) -> None:
    if replaces:
        print(f"foveascan: the code offered to {name!r} before is void now", file=sys.stderr)


def run_list(args: argparse.Namespace) -> int:
    """Print every login."""
    access = _access(_config(args))
    tokens = [(token, access.last_used.of(token.digest)) for token in access.tokens()]
    if args.json:
        said = [
            {"name": token.name, "role": token.role, "created": token.created_unix_s, "lastUsed": used}
            for token, used in tokens
        ]
        print(json.dumps({"tokens": said}))
        return 0
    for token, used in tokens:
        last = f"last used {_minute(used)}" if used else "last used: not known"
        print(f"{_minute(token.created_unix_s)}  {token.role:8} {token.name}  ({last})")
    if not tokens:
        print("nobody is paired")
    return 0


def _minute(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s).isoformat(" ", "minutes")


def run_revoke(args: argparse.Namespace) -> int:
    """End a login."""
    from protocol.errors import AccessError

    config = _config(args)
    if not _access(config).revoke(args.name):
        raise AccessError(f"nobody called {args.name!r} is paired: see foveascan access list")
    note_at_console(config, "revoked", what=args.name)
    print(json.dumps({"revoked": args.name}) if args.json else f"{args.name} is out")
    return 0


def run_audit(args: argparse.Namespace) -> int:
    """Print the audit log."""
    config = _config(args)
    return print_audit(config, _library(config), args)


def _config(args: argparse.Namespace) -> Config:
    from node.config import load_config

    return load_config(args.config, {"library.folder": args.library})


def _library(config: Config) -> Path:
    """The library's folder. Raises AccessError where no node has run: its account would not own what we make."""
    from protocol.errors import AccessError

    folder = config.library.path
    if not folder.is_dir():
        raise AccessError(f"{folder} is no library: start the node once, or name it with --config or --library")
    return folder


def _access(config: Config) -> Access:
    from node.access import Access, access_folder

    return Access(access_folder(_library(config)))


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help="the node's settings (TOML)")
    parser.add_argument("--library", metavar="DIR", help="the node's library; wins over the settings")
    parser.add_argument("--json", action="store_true", help="print one JSON object (audit: one a line)")


def _minutes(text: str) -> float:
    try:
        minutes = float(text)
    except ValueError:
        minutes = 0.0
    if not 0 < minutes <= 60:
        raise argparse.ArgumentTypeError(f"expected minutes above 0, up to 60, got {text!r}")
    return minutes
