"""Set-up of logging: records as plain lines on stderr."""

from __future__ import annotations

import logging

from pgdm.cli.console.screen import notify


class _LineHandler(logging.Handler):
    """Prints log records as ``notify`` does."""

    def emit(self, record: logging.LogRecord) -> None:
        notify(self.format(record))


def set_up_logging(debug: bool) -> None:
    """Print log records on stderr, each as one line."""
    handler = _LineHandler()
    logging.basicConfig(
        format="%(levelname)s: %(message)s", level=logging.WARNING, handlers=[handler]
    )
    logging.getLogger("pgdm").setLevel(logging.DEBUG if debug else logging.WARNING)
    # Warnings of libraries are shown only with --debug.
    logging.captureWarnings(True)
    logging.getLogger("py.warnings").setLevel(logging.WARNING if debug else logging.ERROR)
