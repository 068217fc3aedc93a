"""The node's subcommands: `serve`."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `serve`."""
    serve = subparsers.add_parser("serve", help="run the node: read the scanner, keep scans, serve clients")
    serve.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML); options here win over them")
    serve.add_argument("--library", metavar="DIR", help="folder the scans are kept in")
    serve.add_argument("--listen", metavar="HOST:PORT", help="address to serve (127.0.0.1:7345); port 0: any free one")
    serve.add_argument("--insecure", action="store_true", default=None, help="plain HTTP without login, loopback only")
    serve.add_argument("--scanner", metavar="PATH", help="serial port of the scanner; none: library only")
    serve.add_argument("--baud", type=int, help="its speed in baud (3000000)")
    serve.add_argument("--name", help="name to announce on the network (this host's)")
    serve.add_argument("--json", action="store_true", help="print one JSON object once the node is ready")
    serve.set_defaults(run=run_serve)


def run_serve(args: argparse.Namespace) -> int:
    """Run the node until SIGTERM or SIGINT."""
    import asyncio
    import json
    import logging

    import uvloop

    from node.config import load_config
    from node.daemon import run_node

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    overrides = {
        "library.folder": args.library,
        "server.listen": args.listen,
        "server.insecure": args.insecure,
        "capture.scanner": args.scanner,
        "capture.baud": args.baud,
        "discovery.name": args.name,
    }
    config = load_config(args.config, overrides)

    def ready(url: str) -> None:
        print(json.dumps({"ready": True, "url": url}) if args.json else f"Serving {url}", flush=True)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(run_node(config, ready))
    return 0
