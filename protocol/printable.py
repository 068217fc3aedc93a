"""Words for people: foreign text, which must not steer a terminal or forge a line of a log, and counts of things."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""The text with line breaks, control and formatting characters as escapes ("\n", "\x1b"), all else as it is."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def counted(count: int, what: str) -> str:
    """How many of something there are: "1 scan", "2 scans"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
