"""Results of what is expensive to repeat, on disk: a rival's bytes for a scan never change while its code does not."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

CODE = Path(__file__).parent
FOUNDATION = ("target", "rivals.offer", "rivals.pyramid")


class Cache:
    """JSON results in a folder, by what they were made from and the source they were made with."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def value(self, made_by: str, key: str, make: Callable[[], Any]) -> Any:
        """What `make` returns (as JSON), from disk where it is known. made_by : the source file under tests/bench."""
        if self._folder is None:
            return make()
        path = self._folder / f"{made_by}-{_digest(made_by, key)}.json"
        try:
            return json.loads(path.read_text())
        except FileNotFoundError:
            value = make()
            _write(path, json.dumps(value))
            return value

    def blob(self, made_by: str, key: str, make: Callable[[], bytes]) -> bytes:
        """The same for bytes."""
        if self._folder is None:
            return make()
        path = self._folder / f"{made_by}-{_digest(made_by, key)}.bin"
        try:
            return path.read_bytes()
        except FileNotFoundError:
            data = make()
            _write(path, data)
            return data


def _digest(made_by: str, key: str) -> str:
    """Of what the source means: comments and layout do not count, nor do modules beside the one and its foundation."""
    digest = hashlib.sha256(key.encode())
    for module in (made_by, *FOUNDATION):
        digest.update(ast.dump(ast.parse((CODE / f"{module.replace('.', '/')}.py").read_bytes())).encode())
    return digest.hexdigest()[:24]


def _write(path: Path, content: str | bytes) -> None:
    data = content.encode() if isinstance(content, str) else content
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        file.write(data)
    os.replace(file.name, path)
