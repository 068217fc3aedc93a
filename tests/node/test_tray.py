"""What lies on a tray comes back as it was, to whoever maps it."""

import os

import numpy as np
import pytest

from node.tray import Tray, end_of

PAGE = os.sysconf("SC_PAGE_SIZE")
VALUES = [
    "nothing but text",
    np.arange(12, dtype=np.uint16).reshape(3, 4),
    {"some": np.zeros((0, 3), np.uint8), "more": np.linspace(0, 1, 3 * PAGE), "text": "beside them"},
]


@pytest.mark.parametrize("copied", [True, False])
@pytest.mark.parametrize("value", VALUES, ids=str)
def test_what_was_laid_is_taken_at_the_other_end(value: object, copied: bool) -> None:
    ours = Tray()
    theirs = Tray(os.dup(ours.file))
    np.testing.assert_equal(theirs.take(ours.lay(value), copied=copied), value)


def test_it_grows_as_more_is_laid() -> None:
    ours = Tray()
    theirs = Tray(os.dup(ours.file))
    for pages in (1, 5, 2):
        value = np.full(pages * PAGE, pages, np.uint8)
        np.testing.assert_array_equal(theirs.take(ours.lay(value), copied=True), value)


def test_an_answer_lies_behind_what_it_answers() -> None:
    ours = Tray()
    theirs = Tray(os.dup(ours.file))
    asked = ours.lay(np.arange(100))
    question = theirs.take(asked, copied=False)
    answer = theirs.lay(question[::-1].copy(), end_of(asked))
    np.testing.assert_array_equal(ours.take(answer, copied=True), np.arange(100)[::-1])
    np.testing.assert_array_equal(question, np.arange(100))


def test_what_was_copied_stays_when_something_else_is_laid() -> None:
    tray = Tray()
    first = tray.take(tray.lay(np.arange(100)), copied=True)
    tray.lay(np.zeros(100, np.int64))
    np.testing.assert_array_equal(first, np.arange(100))
    first[0] = 7  # and is the taker's own


def test_its_file_is_closed_with_it() -> None:
    tray = Tray()
    file = tray.file
    tray.lay(np.arange(100))
    del tray
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(file)
