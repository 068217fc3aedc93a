"""Requests beside the stream: what comes in read as records, what goes out written as JSON."""

from __future__ import annotations

from http import HTTPStatus
from typing import Literal, TypeVar, get_args, get_origin

import msgspec
from aiohttp import web

SECURITY_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}

Record = TypeVar("Record")


def query_of(request: web.Request, kind: type[Record]) -> Record:
    """What stands behind the question mark. Raises 400 naming what is wrong with it."""
    try:
        return msgspec.convert(dict(request.query), kind, strict=False)
    except msgspec.ValidationError as error:
        raise web.HTTPBadRequest(text=f"{_in_query(error)}; known: {', '.join(_fields(kind))}") from None


def decoded(body: bytes, kind: type[Record]) -> Record:
    """A body as a record. Raises 400 naming what is wrong with it."""
    try:
        return msgspec.json.decode(body, type=kind)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise web.HTTPBadRequest(text=str(error)) from None


def said(value: object, status: int = 200) -> web.Response:
    """An answer in JSON."""
    return web.Response(body=msgspec.json.encode(value), content_type="application/json", status=status)


def refusal(status: int, message: str) -> web.Response:
    """An error: HTTP's own phrase, and what is wrong."""
    return said({"code": HTTPStatus(status).phrase.lower(), "message": message}, status)


def harden(response: web.StreamResponse) -> None:
    """What every answer says to browsers, and does not say of us."""
    for name, value in SECURITY_HEADERS.items():
        response.headers.setdefault(name, value)
    response.headers["Server"] = "foveascan"  # instead of which Python and which library, to whoever asks


def _in_query(error: msgspec.ValidationError) -> str:
    return str(error).replace("$.", "").replace("Object contains", "there is an")


def _fields(kind: type) -> list[str]:
    """What there is to be asked for, with what may be chosen from."""
    found = []
    for one in msgspec.structs.fields(kind):
        choice = f" ({', '.join(get_args(one.type))})" if get_origin(one.type) is Literal else ""
        found.append(f"{one.encode_name}{choice}")
    return sorted(found)
