"""Raw deflate from the other end: bounded before it is unpacked, and whole."""

from __future__ import annotations

import zlib

from protocol.errors import CodecError


def inflate(payload: bytes, limit_bytes: int, what: str) -> bytes:
    """What a raw deflate stream unpacks to, at most limit_bytes. what : it is, for the message.

    Raises CodecError for a stream that does not inflate, is cut short, goes on too long or has more behind it.
    """
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        data = inflater.decompress(payload, limit_bytes + 1)
    except zlib.error as error:
        raise CodecError(f"{what} does not inflate: {error}") from error
    if not inflater.eof or inflater.unused_data or len(data) > limit_bytes:
        raise CodecError(f"{what} is cut short or too long")
    return data
