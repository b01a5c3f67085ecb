"""Escape control characters in printed text: names of files and runs may contain some."""

from __future__ import annotations

import re
from typing import Any, TextIO

# Control characters except tab and newline, marks that change the direction of text, and bytes of
# file names that are not UTF-8.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return a text with its control characters escaped, such as ``\\x1b``."""
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)


class Printable:
    """A text stream that escapes control characters.

    Args:
        stream: receives the text. Rich finds it as ``rich_proxied_file`` and bypasses the escaping,
            so that its own control characters work.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        """Write a text."""
        return self.rich_proxied_file.write(printable(text))

    def flush(self) -> None:
        """Flush the stream."""
        self.rich_proxied_file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)
