from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

SELECT_MAX = 1024  # descriptors that select takes


@pytest.fixture
def many_open_files() -> Iterator[None]:
    """So many that whatever is opened next has a descriptor that select does not take."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 2 * SELECT_MAX:
        pytest.skip(f"this machine lets a process open {hard} files")
    with ExitStack() as stack:
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * SELECT_MAX), hard))
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        while (file := os.open(os.devnull, os.O_RDONLY)) < SELECT_MAX:
            stack.callback(os.close, file)
        stack.callback(os.close, file)
        yield
