"""Written by `python tests/golden/write_protocol.py`, and only by that."""

import json

import numpy as np
import pytest

from tests.golden.write_protocol import FOLDER, vectors

NOW = vectors()


@pytest.mark.parametrize("name", sorted(NOW))
def test_the_code_still_equals_the_golden_vectors(name: str) -> None:
    golden = (FOLDER / name).read_bytes()
    if "texture_" in name:  # in float32, which processors round differently
        difference = np.frombuffer(golden, np.uint8).astype(int) - np.frombuffer(NOW[name], np.uint8)
        assert np.abs(difference).max() <= 2
        return
    if not name.endswith(".json"):
        assert golden == NOW[name]
        return
    there, here = json.loads(golden), json.loads(NOW[name])
    if isinstance(there, dict):
        assert there.keys() == here.keys()
    for key in there if isinstance(there, dict) else range(max(len(there), len(here))):
        assert there[key] == here[key], f"{name}: {key}"


def test_no_golden_file_is_left_over() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(NOW)
