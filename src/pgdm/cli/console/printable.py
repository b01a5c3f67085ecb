"""What is printed holds no control characters, which a name of a file or a run may bring along."""

from __future__ import annotations

import re
from typing import Any, TextIO

# Control characters but tab and newline, marks that reverse the direction of text, and bytes of
# file names that are not UTF-8.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return a text with its control characters written out, such as ``\\x1b``."""
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)


class Printable:
    """A text stream whose control characters are written out.

    Args:
        stream: where to; rich, which has its own control characters, writes there directly.
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
