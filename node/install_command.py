"""`foveascan install-service`: the node as a service of this machine, its newer versions, and its removal."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

NEXT = """
The node runs, for this machine alone. Name its scanner and the network's address in /etc/foveascan/node.toml, then
    systemctl restart foveascan
    /opt/foveascan/bin/foveascan doctor --config /etc/foveascan/node.toml
    /opt/foveascan/bin/foveascan pair --config /etc/foveascan/node.toml --name me --role admin"""


def add_install_command(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `install-service`."""
    install = subparsers.add_parser(
        "install-service", help="run this version as a service of systemd on this machine; again to update, or remove"
    )
    install.add_argument("--remove", action="store_true", help="stop the service and take the program away")
    install.add_argument("--purge", action="store_true", help="with --remove: delete settings, scans, logins too")
    install.add_argument("--dry-run", action="store_true", help="only say what would be done")
    install.add_argument("--root", type=Path, default=Path("/"), metavar="DIR", help="lay it out below DIR, start none")
    install.add_argument("--json", action="store_true", help="print one JSON object a step")
    install.set_defaults(run=run_install)


def run_install(args: argparse.Namespace) -> int:
    """Do it, and say every step."""
    from node.install import Installer
    from protocol.errors import InstallError

    if args.purge and not args.remove:
        raise InstallError("--purge deletes every scan: it goes with --remove")

    def tell(step: str) -> None:
        print(json.dumps({"step": " ".join(step.split())}) if args.json else step, flush=True)

    installer = Installer(args.root.absolute(), args.dry_run, tell)
    if args.remove:
        installer.remove(purge=args.purge)
        return 0
    installer.install()
    if installer.is_this_machine and not args.dry_run and not args.json:
        print(NEXT)
    return 0
