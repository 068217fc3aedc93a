"""The description that the node serves says what the table of endpoints says, and nothing twice."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from node.endpoints import ENDPOINTS
from node.openapi import described
from tests.node.entrance import entrance

DESCRIPTION: dict[str, Any] = json.loads(described("0"))


def references(part: object) -> set[str]:
    """Every record that a part of the description refers to."""
    if isinstance(part, dict):
        own = {part["$ref"].rpartition("/")[2]} if "$ref" in part else set()
        return own.union(*map(references, part.values()))
    return set().union(*map(references, part)) if isinstance(part, list) else set()


async def test_whoever_may_look_reads_the_description(tmp_path: Path) -> None:
    async with entrance(tmp_path / "library") as node:
        async with node.ask("GET", "/openapi.json", node.token("view")) as answer:
            assert (answer.status, answer.content_type) == (200, "application/json")
            said = await answer.json()
    assert said == DESCRIPTION
    assert said["openapi"].startswith("3.1.") and said["info"] == {"title": "foveascan", "version": "0"}


@pytest.mark.parametrize("name", ENDPOINTS)
def test_every_request_is_described_with_its_role(name: str) -> None:
    method, _, path = name.partition(" ")
    operation = DESCRIPTION["paths"][path][method.lower()]
    role = ENDPOINTS[name].role
    assert bool(operation["security"]) == bool(role)
    assert operation["description"] == (f"Needs the role {role}." if role else "For anybody.")
    assert ("401" in operation["responses"]) == bool(role)
    named = {one["name"] for one in operation["parameters"] if one["in"] == "path"}
    assert named == {part.split("}")[0] for part in path.split("{")[1:]}


def test_every_operation_has_a_name_of_its_own_that_programs_can_be_made_of() -> None:
    names = {
        f"{method.upper()} {path}": operation["operationId"]
        for path, operations in DESCRIPTION["paths"].items()
        for method, operation in operations.items()
    }
    assert names.keys() == set(ENDPOINTS)
    assert len(set(names.values())) == len(names)
    assert all(name.isidentifier() for name in names.values())
    # what programs were made of already: these do not change
    assert names["GET /"] == "get_page"
    assert names["GET /v1/scans"] == "get_scans"
    assert names["GET /v1/scans/{scan}.{format}"] == "get_scans_scan_format"
    assert names["PATCH /v1/scans/{scan}/sidecar"] == "patch_scans_scan_sidecar"
    assert names["DELETE /v1/tokens/{name}"] == "delete_tokens_name"


def test_every_record_is_there_once_and_referred_to() -> None:
    assert references(DESCRIPTION) == set(DESCRIPTION["components"]["schemas"])
    assert DESCRIPTION["components"]["schemas"]["NewCode"]["properties"]["role"]["default"] == "view"
