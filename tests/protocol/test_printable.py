import pytest

from protocol.printable import printable


@pytest.mark.parametrize("text", ["", "Nase, vorher", "中 😀 \"'\\"])
def test_what_can_be_printed_stays(text: str) -> None:
    assert printable(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [("a\nb", r"a\nb"), ("\x1b[31m", r"\x1b[31m"), ("\0", r"\x00"), ("\u202e", r"\u202e")],
)
def test_what_would_steer_a_terminal_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
