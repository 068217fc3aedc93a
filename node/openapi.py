"""The node's HTTP interface as OpenAPI 3.1, for programs: made of the table of endpoints and of its records alone."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping
from functools import cache
from http import HTTPStatus
from typing import Any

import msgspec

from node.auth import COOKIE
from node.endpoints import ENDPOINTS, FORM, Content, Endpoint, statuses

OPENAPI = "3.1.0"
REF = "#/components/schemas/{name}"
LOGINS = {
    "token": {"type": "http", "scheme": "bearer"},
    "browser": {"type": "apiKey", "in": "cookie", "name": COOKIE},
}

Schema = dict[str, Any]


@cache
def described(version: str) -> bytes:
    """The description, as JSON. version : the node's."""
    schemas, components = _schemas(kind for endpoint in ENDPOINTS.values() for kind in _kinds(endpoint))
    paths: dict[str, Schema] = {}
    for endpoint in ENDPOINTS.values():
        paths.setdefault(endpoint.canonical, {})[endpoint.method.lower()] = _operation(endpoint, schemas, components)
    queries = {endpoint.query.__name__ for endpoint in ENDPOINTS.values() if endpoint.query}
    return msgspec.json.encode({
        "openapi": OPENAPI,
        "info": {"title": "foveascan", "version": version},
        "paths": paths,
        "components": {
            "schemas": {name: schema for name, schema in components.items() if name not in queries},
            "securitySchemes": LOGINS,
        },
    })


def _operation(endpoint: Endpoint, schemas: Mapping[Any, Schema], components: Mapping[str, Schema]) -> Schema:
    """What OpenAPI calls an operation."""
    least = f"Needs the role {endpoint.role}." if endpoint.role else "For anybody."
    operation: Schema = {
        "operationId": _name(endpoint),
        "summary": endpoint.does,
        "description": least,
        "security": [{name: []} for name in LOGINS] if endpoint.role else [],
        "parameters": [*_parameters(endpoint, schemas, components)],
        "responses": {
            str(status): {"description": HTTPStatus(status).phrase, **_content(content, schemas)}
            for status, content in statuses(endpoint).items()
        },
    }
    if endpoint.takes:
        operation["requestBody"] = {"required": True, **_content(endpoint.takes, schemas)}
    return operation


def _name(endpoint: Endpoint) -> str:
    """What programs that are made of the description call it: method and path, so it is as stable as these are."""
    words = re.findall(r"\w+", endpoint.canonical.removeprefix("/v1")) or ["page"]
    form = ["form"] if FORM in (endpoint.takes or {}) else []
    return "_".join([endpoint.method.lower(), *words, *form])


def _parameters(
    endpoint: Endpoint, schemas: Mapping[Any, Schema], components: Mapping[str, Schema]
) -> Iterable[Schema]:
    for name, kind in endpoint.parameters.items():
        yield {"name": name, "in": "path", "required": True, "schema": schemas[kind]}
    if endpoint.query:
        query = components[endpoint.query.__name__]
        for name, schema in query["properties"].items():
            yield {"name": name, "in": "query", "required": name in query["required"], "schema": schema}
    for name, kind in endpoint.headers.items():
        yield {"name": name, "in": "header", "required": False, "schema": schemas[kind]}


def _content(content: Content | None, schemas: Mapping[Any, Schema]) -> Schema:
    return {"content": {media: {"schema": schemas[kind]} for media, kind in content.items()}} if content else {}


def _kinds(endpoint: Endpoint) -> Iterable[Any]:
    """Every record of an endpoint."""
    yield from filter(None, (*endpoint.parameters.values(), endpoint.query, *endpoint.headers.values()))
    for content in filter(None, (endpoint.takes, *statuses(endpoint).values())):
        yield from content.values()


def _schemas(kinds: Iterable[Any]) -> tuple[dict[Any, Schema], dict[str, Schema]]:
    """The schema of each kind, and those records that they refer to, by name."""
    every = list(dict.fromkeys(kinds))
    schemas, components = msgspec.json.schema_components(every, ref_template=REF)
    for schema in components.values():
        if "description" in schema:
            schema["description"] = inspect.cleandoc(schema["description"])
    return {kind: {} if kind is bytes else schema for kind, schema in zip(every, schemas, strict=True)}, components
