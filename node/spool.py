"""Files on their way in or out over HTTP: nameless on the library's disk, so that a crash leaves nothing."""

from __future__ import annotations

import asyncio
import errno
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from aiohttp import web

from node.sealed import HAS_DIED, has_died

CHUNK_BYTES = 1 << 18
STALL_S = 60.0


@contextmanager
def spool(folder: Path) -> Iterator[BinaryIO]:
    """A nameless file on the disk of a folder. Raises an HTTP error where that is full, which may show at the end."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            yield file
    except (ConnectionError, TimeoutError):
        raise
    except OSError as problem:
        raise disk_trouble(problem) from problem


async def send(request: web.Request, file: BinaryIO, name: str, media_type: str) -> web.StreamResponse:
    """Answer with a file that has been written to its end. Raises TimeoutError when the reader stalls for STALL_S."""
    response = web.StreamResponse(headers={"Content-Disposition": f'attachment; filename="{name}"'})
    response.content_type = media_type
    response.content_length = file.tell()
    await response.prepare(request)
    file.seek(0)
    while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
        async with asyncio.timeout(STALL_S):
            await response.write(chunk)
    await response.write_eof()
    return response


def disk_trouble(problem: OSError) -> web.HTTPException:
    """What failed on the node's disk, in the terms of HTTP."""
    if isinstance(problem, ConnectionError):
        return web.HTTPBadRequest(text="the connection was lost")
    if has_died(problem):
        return web.HTTPServiceUnavailable(text=HAS_DIED)
    if problem.errno == errno.ENOSPC:
        return web.HTTPInsufficientStorage(text="the node's disk is full")
    return web.HTTPInternalServerError(text=f"the node's disk: {problem.strerror}")
