"""The node's subcommands: `serve` and `doctor`."""

from __future__ import annotations

import argparse
from pathlib import Path

from node.access_command import add_access_commands
from node.install_command import add_install_command
from node.library_command import add_library_command

ADDRESS = "the scanner's: path of a serial port, serial:VID:PID[:SERIAL], usb:VID:PID[:SERIAL] or tcp:HOST:PORT"


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `serve` and `doctor`."""
    add_library_command(subparsers)
    add_access_commands(subparsers)
    add_install_command(subparsers)
    serve = subparsers.add_parser("serve", help="run the node: read the scanner, keep scans, serve clients")
    serve.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML); options here win over them")
    serve.add_argument("--library", metavar="DIR", help="folder the scans are kept in")
    serve.add_argument("--listen", metavar="HOST:PORT", help="address to serve (127.0.0.1:7345); port 0: any free one")
    serve.add_argument("--insecure", action="store_true", default=None, help="plain HTTP without login, loopback only")
    serve.add_argument("--scanner", metavar="ADDRESS", help=f"{ADDRESS}; none: library only")
    serve.add_argument("--baud", type=_baud, help="its speed in baud, 9600..12000000 (3000000)")
    serve.add_argument("--name", help="name to announce on the network (this host's)")
    serve.add_argument("--log", choices=("auto", "text", "json"), help="how the log is written; auto: as text (auto)")
    serve.add_argument("--check", action="store_true", help="only say whether the settings are sound")
    serve.add_argument("--json", action="store_true", help="print one JSON object once the node is ready")
    serve.set_defaults(run=run_serve)

    doctor = subparsers.add_parser("doctor", help="say what keeps a node from working here, and the cure")
    doctor.add_argument("--config", type=Path, metavar="FILE", help="settings the node runs with (TOML)")
    doctor.add_argument("--scanner", metavar="ADDRESS", help="the scanner's, instead of the one set there")
    doctor.add_argument("--library", metavar="DIR", help="folder the scans are kept in, instead of the one set there")
    doctor.add_argument("--listen", metavar="HOST:PORT", help="address it serves, instead of the one set there")
    doctor.add_argument(
        "--link",
        metavar="ADDRESS",
        help="check a scanner's firmware instead, by sweeping with it several times: with nothing on the table",
    )
    doctor.add_argument("--json", action="store_true", help="print one JSON object a check")
    doctor.set_defaults(run=run_doctor)


def _baud(text: str) -> int:
    """A speed that configuration knows. Raises ArgumentTypeError."""
    if not (text.isascii() and text.isdigit() and len(text) <= 8 and 9600 <= int(text) <= 12_000_000):
        raise argparse.ArgumentTypeError(f"expected 9600..12000000 baud, got {text!r}")
    return int(text)


def run_serve(args: argparse.Namespace) -> int:
    """Run the node until SIGTERM or SIGINT; on SIGHUP it reads its settings anew."""
    import asyncio
    import faulthandler
    import json
    from functools import partial

    import uvloop

    from node.config import load_config
    from node.daemon import run_node
    from node.log import set_log, start_log
    from node.memory import bound_arenas

    start_log()
    bound_arenas()
    faulthandler.enable()  # a watchdog ends us with SIGABRT: then the journal says where every thread was
    overrides = {
        "library.folder": args.library,
        "server.listen": args.listen,
        "server.insecure": args.insecure,
        "capture.scanner": args.scanner,
        "capture.baud": args.baud,
        "discovery.name": args.name,
        "log.format": args.log,
    }
    reread = partial(load_config, args.config, overrides)
    config = reread()
    set_log(config.log.level, config.log.format)
    if args.check:
        print(json.dumps({"sound": True}) if args.json else "the settings are sound")
        return 0

    def ready(url: str) -> None:
        print(json.dumps({"ready": True, "url": url}) if args.json else f"Serving {url}", flush=True)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(run_node(config, ready, reread))
    return 0


def run_doctor(args: argparse.Namespace) -> int:
    """Print what each check finds; status 1 when one finds a problem."""
    import json
    from dataclasses import asdict

    from node.doctor import examine, examine_scanner

    overrides = {"capture.scanner": args.scanner, "library.folder": args.library, "server.listen": args.listen}
    if args.link is None:
        findings = examine(args.config, overrides)
    else:
        if not args.json:
            print("This sweeps with the scanner, several times.", flush=True)
        findings = examine_scanner(args.link, args.config, overrides)
    has_problem = False
    for finding in findings:
        has_problem |= finding.state == "problem"
        if args.json:
            print(json.dumps(asdict(finding)), flush=True)
            continue
        print(f"{finding.state:8} {finding.check:14} {finding.found}", flush=True)
        if finding.cure:
            print(f"{'':23} cure: {finding.cure}", flush=True)
    return int(has_problem)
