"""The WebSocket to a node: messages and refinements in and out, every failure of the carrier as one of our errors."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress

import aiohttp
from aiohttp import ClientWebSocketResponse, ClientWSTimeout, WSCloseCode, WSMsgType

from client.errors import NodeLost, RequestRefused
from client.rest import ask
from client.trust import UNTRUSTED, other_scheme, trouble
from protocol import messages as m
from protocol.errors import RemoteWireError
from protocol.printable import printable
from protocol.refinement import CRC, HEADER, MASK_MAX, PARAMETERS_MAX, PAYLOAD_MAX
from protocol.session import Role, Said
from protocol.session import Session as Order

PATH = "/v1/stream"
MESSAGE_MAX_BYTES = HEADER.size + PARAMETERS_MAX + MASK_MAX + PAYLOAD_MAX + CRC.size
HANDSHAKE_S = 10
HEARTBEAT_S = 15
CLOSE_S = 2
CLOSE_REASON_MAX_BYTES = 120
BUSY = 503


class Stream:
    """One open WebSocket. bytes_sent, bytes_received : of its messages."""

    def __init__(self, socket: ClientWebSocketResponse, url: str) -> None:
        self.url = url
        self.bytes_sent = 0
        self.bytes_received = 0
        self._socket = socket
        self._order = Order(Role.CLIENT)

    async def greet(self) -> m.ServerInfo:
        """Exchange greetings. Raises NodeLost, RequestRefused, or RemoteWireError for a node of another protocol."""
        info, _ = await self.receive()
        assert isinstance(info, m.ServerInfo)  # the order of a stream allows nothing else here
        if info.protocol != m.PROTOCOL:
            raise RemoteWireError(f"{self.url} speaks {info.protocol}, we {m.PROTOCOL}: update the older of the two")
        await self.send(m.Hello(m.PROTOCOL, "foveascan", geometries=("cylinder", "sphere")))
        match await self.receive():
            case m.Refused(code=code, message=message), _:
                raise RequestRefused(code, message)
            case m.Goodbye(reason=reason), _:
                raise NodeLost(f"{self.url} ended the stream: {reason}")
        return info

    async def receive(self) -> tuple[Said, int]:
        """The next thing the node says, and its size in bytes. Raises NodeLost or RemoteWireError."""
        message = await self._socket.receive()
        if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
            raise self._ended(message)
        data: str | bytes = message.data
        size = len(data.encode()) if isinstance(data, str) else len(data)
        self.bytes_received += size
        return self._order.receive(data), size

    async def send(self, message: m.FromClient) -> None:
        """Say something; waits while the node reads slowly. Raises LocalWireError, NodeLost."""
        text = str(self._order.send(message))
        try:
            await self._socket.send_str(text)
        except (aiohttp.ClientError, OSError) as error:
            raise NodeLost(f"lost {self.url}: {error}") from error
        self.bytes_sent += len(text.encode())

    async def close(self, violation: RemoteWireError | None = None) -> None:
        """Close the stream; tell the node what it did wrong, if anything."""
        code = WSCloseCode.PROTOCOL_ERROR if violation else WSCloseCode.OK
        reason = str(violation or "").encode()[:CLOSE_REASON_MAX_BYTES].decode(errors="ignore").encode()
        await self._socket.close(code=code, message=reason)

    def _ended(self, last: aiohttp.WSMessage) -> NodeLost | RemoteWireError:
        if isinstance(last.data, aiohttp.WebSocketError):
            return RemoteWireError(f"{self.url} broke the WebSocket protocol: {last.data}")
        reason = f": {printable(str(last.extra))}" if last.type is WSMsgType.CLOSE and last.extra else ""
        why = f"the node closed the stream ({self._socket.close_code}){reason}"
        if last.type is WSMsgType.ERROR and last.data:
            why = str(last.data)
        return NodeLost(f"lost {self.url}: {why}; connect again once the node is back")


async def open_stream(http: aiohttp.ClientSession, url: str) -> tuple[Stream, m.ServerInfo]:
    """Connect to the node at `url` and exchange greetings. Raises what `logged_in` and `Stream.greet` raise."""
    try:
        async with asyncio.timeout(HANDSHAKE_S):
            stream = Stream(await _connect(http, url), url)
            try:
                return stream, await stream.greet()
            except BaseException as error:
                await stream.close(error if isinstance(error, RemoteWireError) else None)
                raise
    except TimeoutError as error:
        raise NodeLost(f"{url} does not answer; check the address, or restart the node") from error


async def _connect(http: aiohttp.ClientSession, url: str) -> ClientWebSocketResponse:
    try:
        socket = await http.ws_connect(
            f"{url}{PATH}",
            protocols=[m.PROTOCOL],
            max_msg_size=MESSAGE_MAX_BYTES,
            heartbeat=HEARTBEAT_S,
            timeout=ClientWSTimeout(ws_close=CLOSE_S),
        )
    except UNTRUSTED as error:  # first: some are ValueErrors too
        raise trouble(url, error) from error
    except (aiohttp.InvalidURL, aiohttp.NonHttpUrlClientError, ValueError) as error:
        raise NodeLost(f"{url!r} is no address of a node; use https://HOST:PORT") from error
    except aiohttp.WSServerHandshakeError as error:
        raise await _refusal(http, url, error.status) from error
    except aiohttp.ClientConnectorError as error:
        if other := other_scheme(url, error):
            raise NodeLost(f"no node at {url}: {other}") from error
        why = _reason(error.os_error)
        raise NodeLost(f"no node at {url}: {why}; check the address, or start one with `foveascan serve`") from error
    except (aiohttp.ClientError, OSError) as error:
        raise NodeLost(f"{url} is no foveascan node: {other_scheme(url, error) or error}") from error
    if socket.protocol != m.PROTOCOL:
        await socket.close()
        raise RemoteWireError(f"{url} does not speak {m.PROTOCOL}: update the older of the two")
    return socket


def _reason(error: OSError) -> str:
    """asyncio's own text names the call, not the reason; a failed look-up of a name has no errno of the system."""
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno).lower()
    return (error.strerror or str(error)).lower()


async def _refusal(http: aiohttp.ClientSession, url: str, status: int) -> NodeLost | RequestRefused:
    if status in (401, 403):
        return RequestRefused("forbidden", "it wants a token that was not revoked: pair with `foveascan join CODE`")
    if status == BUSY:
        with suppress(NodeLost, RemoteWireError):
            try:
                await ask(http, "GET", f"{url}{PATH}")  # a handshake keeps the reason for itself
            except RequestRefused as refused:
                return RequestRefused("busy", refused.message)
    return NodeLost(f"{url} answers with HTTP {status}: it is no foveascan node")
