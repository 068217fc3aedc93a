"""A short run of `foveascan bench fuzz --target openapi`: the same requests every time."""

from __future__ import annotations

import pytest

from tests.fuzz.described import PHASES, ask_as

BRIEFLY = ("examples", "fuzzing")


@pytest.mark.timeout(600)  # fifteen seconds' work, on a machine that may have much of it
def test_the_node_answers_as_its_description_says() -> None:
    record = ask_as({None: BRIEFLY, "view": BRIEFLY, "admin": PHASES}, 2, 0)
    assert record["failures"] == []
    assert record["requests"] > 800
