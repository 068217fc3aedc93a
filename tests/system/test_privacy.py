"""A whole run of a real daemon, with everything that goes wrong in it: its log tells nothing of patients or logins."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import urllib.parse
from pathlib import Path

import aiohttp
import pytest

from client import NodeLost, connect
from client.trust import certificate_pin
from exchange.native import write_native
from foveascan import PROGRAM
from node.access import Access, access_folder
from tests.node.scans import make_grid

NAME, SUBJECT, NOTES, SITE = "Erika-Mustermann", "subject-0815", "melanoma-of-the-left", "left-cheek"
LOGIN = "Praxis-Dr-Beispiel"


async def test_the_log_of_a_whole_run_names_nobody_and_shows_no_secret(tmp_path: Path) -> None:
    library, log = tmp_path / "library", tmp_path / "log"
    settings = tmp_path / "node.toml"
    settings.write_text('[log]\nlevel = "debug"\nformat = "json"\n[discovery]\nenabled = false\n')
    serve = "serve", "--config", settings, "--library", library, "--listen", "127.0.0.1:0", "--json"
    with open(log, "wb") as file:
        command = [*PROGRAM, *map(str, serve)]
        node = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=file, stdin=subprocess.DEVNULL)
    try:
        assert node.stdout is not None
        url = json.loads(await asyncio.to_thread(node.stdout.readline))["url"]
        secrets = await a_day_in_the_clinic(url, library, tmp_path)
    finally:
        node.terminate()
        assert await asyncio.to_thread(node.wait, 20) == 0
        assert node.stdout is not None
        node.stdout.close()
    said = log.read_text()
    lines = [json.loads(line) for line in said.splitlines()]
    assert {"node.auth", "node.connection", "node.pairing"} <= {line["logger"] for line in lines}
    for secret in (*secrets, NAME, SUBJECT, NOTES, SITE, LOGIN):
        assert secret not in said, secret
        assert urllib.parse.quote(secret, safe="") not in said, secret
    audited = b"".join(path.read_bytes() for path in (library / "audit").iterdir()).decode()
    for secret in (*secrets, NAME, SUBJECT, NOTES, SITE):
        assert secret not in audited, secret
    assert LOGIN in audited  # there it belongs


async def a_day_in_the_clinic(url: str, library: Path, folder: Path) -> list[str]:
    """Everything that handles names, subjects, codes and tokens, well and badly; returns the secrets."""
    access = Access(access_folder(library))
    token, admin = access.grant("operate", LOGIN, os.stat(library).st_mtime), access.grant("admin", "boss", 1e9)
    fingerprint = json.loads(await command("pair", "--name", "room 9", "--library", str(library), "--json"))
    code, secrets = fingerprint["code"], [token, admin, fingerprint["code"], "wrong-token-4711", "WRNG-CODE-AAAA-AAAA"]
    connector = aiohttp.TCPConnector(ssl=certificate_pin(fingerprint["fingerprint"]))
    with open(folder / "scan.npz", "wb") as file:
        write_native(make_grid(40, 24), file)

    async with aiohttp.ClientSession(connector=connector, headers={"Authorization": f"Bearer {token}"}) as http:
        body = (folder / "scan.npz").read_bytes()
        async with http.post(f"{url}/v1/scans", data=body) as answer:
            scan = (await answer.json())["id"]
        place = f"{url}/v1/scans/{scan}"
        said = {"name": NAME, "subject": SUBJECT, "notes": NOTES, "body_site": SITE}
        for method, path, more in [
            ("PATCH", f"{place}/sidecar", {"json": said}),
            ("PATCH", f"{place}/sidecar", {"json": {NAME: 1}}),
            ("PATCH", f"{place}/sidecar", {"data": f"{{{SUBJECT}".encode()}),
            ("GET", f"{place}/sidecar?{SUBJECT}", {}),
            ("GET", f"{url}/v1/scans/{NAME}", {}),
            ("GET", f"{url}/{SUBJECT}", {}),
            ("GET", f"{place}/fovea?u=0.5&v=0.5&{NAME}=1", {}),
            ("GET", f"{place}.glb", {}),
            ("POST", f"{url}/v1/scans", {"data": NOTES.encode() * 100}),
            ("POST", f"{url}/pair", {"data": {"code": "WRNG-CODE-AAAA-AAAA"}, "headers": {"Origin": url}}),
            ("POST", f"{url}/pair", {"data": {"code": code}, "headers": {"Origin": url}}),
            ("GET", f"{url}/v1/scans", {"headers": {"Authorization": "Bearer wrong-token-4711"}}),
            ("GET", f"{url}/v1/scans", {"headers": {"Origin": f"https://{NAME}.example"}}),
        ]:
            async with http.request(method, path, **more, allow_redirects=False) as answer:  # type: ignore[arg-type]
                await answer.read()
        async with http.ws_connect(f"{url}/v1/stream", protocols=["foveascan.v1"]) as stream:
            await stream.send_str(f'{{"type":"{SUBJECT}"}}')
            while (await stream.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
        async with connect(url, token, fingerprint["fingerprint"]) as session:
            await session.open("latest")
            await session.look(0.5, 0.5)
            access.revoke(LOGIN)
            with pytest.raises(NodeLost, match="revoked"):
                await anext(session.published())
    return secrets


async def command(*arguments: str) -> bytes:
    program = await asyncio.create_subprocess_exec(*PROGRAM, *arguments, stdout=subprocess.PIPE)
    said, _ = await program.communicate()
    assert program.returncode == 0
    return said


