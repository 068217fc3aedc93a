"""No parser is left out: whatever takes bytes or text apart is entered by a target's valid inputs, or named here."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType

import pytest

from tests.fuzz.parsers import targets

ROOT = Path(__file__).parents[2]
PACKAGES = ("protocol", "drivers", "exchange", "node", "client")
TAKES_APART = frozenset({
    "convert", "decompress", "frombuffer", "from_bytes", "fromhex", "fullmatch", "htj2k_decode", "imdecode", "iter_unpack",
    "ip_address", "jpeg8_decode", "load", "load_pem_private_key", "load_pem_x509_certificate", "load_scene", "loads",
    "unpack", "unpack_from", "URL", "ZipFile",
})  # fmt: skip
OUR_OWN = {
    "exchange/obj.py write_obj_zip": "writes",
    "node/sidecar.py _checked": "reads what it has just written",
    "node/log.py format": "writes",
    "protocol/codec_htj2k.py _strip": "reads what the encoder has just written",
    "protocol/codec_jpeg.py _strip": "the same",
}
BY_OTHER_MEANS = {
    "client/derive.py derive_scan": "an answer that `answer` reads, into a record",
    "client/pairing.py _checked": "the same",
    "client/session.py quality": "the same",
}
"""Functions that need none."""


def takers_apart() -> Iterator[str]:
    """Every function that calls one of these, or a decoder's `decode`: "file function"."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).glob("*.py")):
            for function in ast.walk(ast.parse(path.read_text())):
                if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef) and any(map(_takes, ast.walk(function))):
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

    for target in list(targets(tmp_path_factory.mktemp("complete"))):
        sys.setprofile(see)
        try:
            for data in target.seeds:
                with suppress(*target.may):
                    target.parse(data)
        finally:
            sys.setprofile(None)
    return {name.removeprefix(f"{ROOT}/") for name in found}


def test_every_function_that_takes_something_apart_is_fuzzed(entered: set[str]) -> None:
    assert sorted(set(takers_apart()) - entered - OUR_OWN.keys() - BY_OTHER_MEANS.keys()) == []
