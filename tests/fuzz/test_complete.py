"""No parser is left out: whatever takes bytes or text apart is entered by a target's valid inputs, or named here."""

from __future__ import annotations

import ast
import gc
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import _lru_cache_wrapper
from pathlib import Path
from types import FrameType

import pytest

from tests.fuzz.parsers import targets

ROOT = Path(__file__).parents[2]
PACKAGES = ("protocol", "drivers", "exchange", "node", "client")
TAKES_APART = frozenset({
    "convert", "decompress", "frombuffer", "from_bytes", "fromhex", "fullmatch", "htj2k_decode", "imdecode",
    "iter_unpack", "ip_address", "jpeg8_decode", "load", "load_pem_private_key", "load_pem_x509_certificate",
    "load_scene", "loads",
    "unpack", "unpack_from", "URL", "ZipFile",
})  # fmt: skip
NEEDS_NONE = {
    "client/rest.py checked": "an answer that `answer` has read",
    "client/session.py _checked_look": "the caller's own values",
    "client/trust.py check": "a hash that we made",
    "client/trust.py other_scheme": "the same as `trouble`",
    "client/trust.py trouble": "an address that `url` has read",
    "drivers/ledger.py missing": "our own account",
    "exchange/obj.py write_obj_zip": "writes",
    "node/access.py _checked": "the caller's own values",
    "node/advertise.py __init__": "this machine's addresses",
    "node/advertise.py _interfaces": "the same",
    "node/advertise.py _own_addresses": "the same",
    "node/audit_command.py print_audit": "writes",
    "node/listener.py _answer": "whatever it raises means that it is no node",
    "node/endpoints.py is_scan": "a yes or no; the requests with it are fuzzed",
    "node/install.py _laid": "a list that root has written, and reads",
    "node/journal.py _meet": "names of files",
    "node/library_folder.py _is_restore": "the same",
    "node/library_folder.py tidy": "the same",
    "node/log.py format": "writes",
    "node/proxy.py believe": "addresses that `config` has read",
    "node/shared.py may_hand_out": "a pattern, which `original-uri` is matched with",
    "node/sidecar.py _checked": "what we have just written",
    "node/tls.py _names": "this machine's names",
    "node/tray.py take": "what a process of ours has laid there",
    "protocol/codec_htj2k.py _strip": "what the encoder has just written",
    "protocol/codec_jpeg.py _strip": "the same",
    "protocol/codec_lift.py _expected_bytes": "the same",
}
"""Functions without a target, and what it is that they read."""


def takers_apart() -> Iterator[str]:
    """Every function that calls one of these, or a decoder's `decode`: "file function"."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).glob("*.py")):
            for function in ast.walk(ast.parse(path.read_text())):
                if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                    continue
                if any(map(_takes, ast.walk(function))):
                    yield f"{package}/{path.name} {function.name}"


def _takes(node: ast.AST) -> bool:
    if not isinstance(node, ast.Call):
        return False
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    is_decoder = name == "decode" and isinstance(node.func, ast.Attribute) and "json" in ast.unparse(node.func.value)
    return name in TAKES_APART or is_decoder


@pytest.fixture(scope="module")
def entered(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Every function that the valid inputs of all targets came through."""
    found: set[str] = set()

    def see(frame: FrameType, event: str, argument: object) -> None:
        if event == "call":
            found.add(f"{frame.f_code.co_filename} {frame.f_code.co_name}")

    ready = list(targets(tmp_path_factory.mktemp("complete")))
    forget_answers()
    for target in ready:
        sys.setprofile(see)
        try:
            for data in target.seeds:
                with suppress(*target.may):
                    target.parse(data)
        finally:
            sys.setprofile(None)
    return {name.removeprefix(f"{ROOT}/") for name in found}


def forget_answers() -> None:
    """Have functions that keep their answers entered again, whatever they were asked before in this process."""
    for kept in filter(lambda thing: isinstance(thing, _lru_cache_wrapper), gc.get_objects()):
        if str(kept.__module__).partition(".")[0] in PACKAGES:
            kept.cache_clear()


def test_every_function_that_takes_something_apart_is_fuzzed(entered: set[str]) -> None:
    assert sorted(set(takers_apart()) - entered - NEEDS_NONE.keys()) == []


def test_the_list_of_functions_without_a_target_is_no_longer_than_it_must_be(entered: set[str]) -> None:
    assert NEEDS_NONE.keys() <= set(takers_apart()) - entered
