import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from node.beside import both


def test_does_both_in_the_calling_thread_without_a_pool() -> None:
    assert both(None, threading.get_ident, threading.get_ident) == (threading.get_ident(), threading.get_ident())


def test_does_one_in_a_free_thread_while_the_caller_does_the_other() -> None:
    begun = threading.Event()

    def one() -> int:
        begun.set()
        return threading.get_ident()

    def other() -> int:
        assert begun.wait(60)  # nobody else would set it
        return threading.get_ident()

    with ThreadPoolExecutor(1) as pool:
        there, here = both(pool, one, other)
    assert here == threading.get_ident() != there


def test_a_job_in_the_only_thread_of_a_pool_waits_for_nobody() -> None:
    with ThreadPoolExecutor(1) as pool:
        there, here = pool.submit(both, pool, threading.get_ident, threading.get_ident).result(60)
    assert there == here


def test_a_pool_that_is_shut_down_changes_nothing() -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    assert both(pool, lambda: 1, lambda: 2) == (1, 2)


@pytest.mark.parametrize("threads", [0, 1])
@pytest.mark.parametrize("which", [0, 1])
def test_raises_what_either_raises(threads: int, which: int) -> None:
    def fail() -> None:
        raise LookupError

    jobs = [fail, lambda: None] if which == 0 else [lambda: None, fail]
    with ThreadPoolExecutor(1) as pool, pytest.raises(LookupError):
        both(pool if threads else None, *jobs)
