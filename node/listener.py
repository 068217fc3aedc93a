"""Who listens at the address where a node shall: it is asked how it is, as anybody may ask a node."""

from __future__ import annotations

import http.client
import ssl
from typing import Literal

import msgspec

from node.config import Server

ANSWER_S = 2.0
ANSWER_BYTES_MAX = 65536

Listener = Literal["node", "other", "nobody"]


def who_answers(server: Server) -> Listener:
    """Who listens at the node's address."""
    if server.port == 0:
        return "nobody"
    who = _answer(server, server.insecure)
    if who == "strange":  # a node that was told --insecure, or not to be: nobody need tell us
        who = "node" if _answer(server, not server.insecure) == "node" else "other"
    return who


def _answer(server: Server, insecure: bool) -> Listener | Literal["strange"]:
    """Who answers in plain HTTP, or over TLS. "strange": it does not speak that."""
    line = _line_to(server, insecure)
    try:
        line.request("GET", "/healthz")
        answer = msgspec.json.decode(line.getresponse().read(ANSWER_BYTES_MAX))
        return "node" if isinstance(answer, dict) and "status" in answer else "other"
    except (ssl.SSLError, ConnectionResetError):
        return "strange"
    except OSError as error:
        return "other" if error.errno is None else "nobody"
    except (http.client.HTTPException, ValueError, RecursionError):
        return "other"
    finally:
        line.close()


def _line_to(server: Server, insecure: bool) -> http.client.HTTPConnection:
    if insecure:
        return http.client.HTTPConnection(server.host, server.port, timeout=ANSWER_S)
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE  # nothing is told, and little believed
    return http.client.HTTPSConnection(server.host, server.port, timeout=ANSWER_S, context=context)
