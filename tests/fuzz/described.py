"""The node asked whatever its own description allows, and what it does not, by schemathesis, as each role.

schemathesis runs as a program: as a plugin it would change how pytest and hypothesis do everything else. What it finds:
answers that the description does not have (a status, a media type, a body), a 5xx, a request taken that is wrong or
refused that is right, a method that is neither there nor refused with `Allow`.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from foveascan import started
from node.access import Access, access_folder
from node.endpoints import ENDPOINTS
from node.library import About, Library
from node.openapi import described
from protocol.pairing import Role
from tests.exchange.grids import vase

ROLES: tuple[Role | None, ...] = (None, "monitor", "view", "operate", "admin")
STRANGERS = (None, "monitor")  # a method that is not there is 401 or 403 to them, as whatever is not there
PHASES = ("examples", "coverage", "fuzzing")
TAIL = 6000
SETTINGS = """
[server]
listen = "127.0.0.1:0"
[limits]
requests_s_per_address = 100000.0
[library]
folder = "{folder}/library"
spheres = false
[discovery]
enabled = false
[log]
level = "error"
"""
# Auth is left to tests/node/test_auth.py: twenty wrong tokens lock the address. What a scan cannot be made into is 422,
# a URL of an older epoch 410 whatever else it says, a revision that is over 412.
CHECKS = """
continue-on-failure = true
tls-verify = false
warnings = false
[checks]
ignored_auth.enabled = false
[checks.positive_data_acceptance]
expected-statuses = ["2xx", "3xx", 401, 403, 404, 409, 410, 412, 422, 429]
[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 409, 410, 412, 413, 415, 422, 429]
"""


def attack_described(count: int, seed: int) -> dict[str, Any]:
    """About so many requests, as each role."""
    return ask_as(dict.fromkeys(ROLES, PHASES), max(count // (len(ROLES) * len(ENDPOINTS)), 1), seed)


def ask_as(roles: Mapping[Role | None, Sequence[str]], examples: int, seed: int) -> dict[str, Any]:
    """Ask a node of its own as each role, in some of PHASES, with so many examples of each request in that of fuzzing.

    Returns how many requests there were, and what was found.
    """
    with tempfile.TemporaryDirectory(prefix="fs-described-") as name:
        folder = Path(name)
        with closing(Library(folder / "library")) as library:
            scan = library.add(vase(), About(1.0)).id
        access = Access(access_folder(folder / "library"))
        logins = {role: access.grant(role, f"the {role}", time.time()) for role in roles if role}
        (folder / "node.toml").write_text(SETTINGS.format(folder=folder))
        (folder / "checks.toml").write_text(CHECKS)
        (folder / "openapi.json").write_text(_description(scan))
        record: dict[str, Any] = {"requests": 0, "failures": []}
        with started("serve", "--config", f"{folder}/node.toml", "--json") as (node, ready):
            for role, phases in roles.items():
                how = ["--seed", str(seed), "-n", str(examples), "--phases", ",".join(phases)]
                login = ["-H", f"Authorization: Bearer {logins[role]}"] if role else []
                hidden = ["--exclude-checks", "unsupported_method"] if role in STRANGERS else []
                requests, failure = _ask(folder, ready["url"], [*how, *login, *hidden])
                record["requests"] += requests
                record["failures"] += [f"as {role or 'nobody'}: {failure}"] if failure else []
            if (status := node.poll()) is not None:
                record["failures"].append(f"the node ended with status {status}")
        return record


def _description(scan: str) -> str:
    """The node's own, with a scan that is there for what changes one, and a body that schemathesis can make.

    Without the stream: that is no HTTP after its first words, and `network.attack_stream` sees to it.
    """
    said = json.loads(described("0"))
    del said["paths"]["/v1/stream"]
    said["paths"]["/v1/scans/{scan}/sidecar"]["patch"]["parameters"][0]["example"] = scan
    content = said["paths"]["/v1/scans"]["post"]["requestBody"]["content"]
    content["application/octet-stream"] = content.pop("application/zip")
    return json.dumps(said)


def _ask(folder: Path, url: str, more: Sequence[str]) -> tuple[int, str]:
    """One run: how many requests it made, and what it found, "" for nothing."""
    program = [sys.executable, "-m", "schemathesis.cli", "--config-file", f"{folder}/checks.toml", "run"]
    quietly = ["--no-color", "--generation-database", "none"]
    done = subprocess.run(
        [*program, f"{folder}/openapi.json", "-u", url, *quietly, *more],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    counted = re.search(r"^ *(\d+) generated", done.stdout, re.MULTILINE)
    if done.returncode or not counted:
        _, _, found = done.stdout.partition("= FAILURES =")
        return 0, (found or done.stdout + done.stderr)[:TAIL]
    return int(counted[1]), ""
