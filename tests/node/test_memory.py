"""How the node keeps its memory flat."""

from __future__ import annotations

import gc

from node.memory import settle


def test_what_was_there_at_the_start_is_looked_at_no_more() -> None:
    there = [object()]
    try:
        settle()
        assert gc.get_freeze_count() > 0
        assert not any(one is there for one in gc.get_objects())
    finally:
        gc.unfreeze()
