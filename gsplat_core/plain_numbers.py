"""Parsing of numbers in text written by a user.

`int` and `float` also accept `1_0` and the digits of other scripts. In a command line or an address, such text is a
typing error.
"""

from __future__ import annotations


def is_plain(text: str) -> bool:
    """Return True if a text has ASCII characters only, and neither underscores nor surrounding blanks."""
    return text.isascii() and "_" not in text and text == text.strip()


def plain_float(text: str) -> float:
    """Return the number that a text states.

    Raises:
        ValueError: if the text is no number, or is written with underscores, blanks or digits of other scripts.
    """
    if not is_plain(text):
        raise ValueError(f"{text!r} is not a plain number")
    return float(text)
