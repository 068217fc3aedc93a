"""What who looks after a node is told of it."""

from __future__ import annotations

from pathlib import Path

from client import connect
from node.config import Retention
from node.library import Library
from tests.node.entrance import entrance
from tests.node.served import served


async def test_an_admin_is_told_how_the_node_is_kept(tmp_path: Path) -> None:
    async with entrance(tmp_path / "library", retention=Retention(max_age_days=365)) as node:
        async with connect(node.url, node.token("view"), node.tls.fingerprint):
            async with node.ask("GET", "/v1/upkeep", node.token("admin")) as answer:
                said = await answer.json()
        certificate = {"fingerprint": node.tls.fingerprint, "ends": node.tls.ends_unix_s, "own": True}
    assert (said["version"], said["status"], said["reasons"]) == ("0", "ready", [])
    assert said["certificate"] == certificate
    assert said["retention"] == {"maxAgeDays": 365, "maxGb": None}
    assert (said["scans"], said["interrupted"], said["streams"]) == (1, 0, 1)
    assert 0 < said["disk"]["freeBytes"] < said["disk"]["sizeBytes"]
    assert said["capture"]["phase"] == "no scanner"


async def test_without_logins_there_is_no_certificate_to_tell_of(tmp_path: Path) -> None:
    async with served(Library(tmp_path)) as (client, _), client.get("/v1/upkeep") as answer:
        assert (answer.status, (await answer.json())["certificate"]) == (200, None)
