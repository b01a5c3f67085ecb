"""Keeps the labeler's server to this machine's own page."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import rich
import viser
from viser import _messages
from viser.infra import WebsockClientConnection

HOST = "127.0.0.1"
"""Only this machine: the page asks for no password."""


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Keep viser's own words from the terminal, while inside."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def open_server(port: int) -> viser.ViserServer:
    """Start a server that only this machine's own page can use.

    viser lets any page that the user's browser shows connect to it, and has it publish itself by
    a tunnel if that page asks for it. Here connections from other pages are closed, and no message
    opens a tunnel.

    Args:
        port: to listen at; viser takes the next free one if it is taken.
    """
    with quietly():
        server = viser.ViserServer(HOST, port, label="pgdm labeler", verbose=False)
    inner = server._websock_server
    for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        inner.unregister_handler(message)
    allowed = {f"http://{name}:{server.get_port()}" for name in (HOST, "localhost")}

    async def check(connection: WebsockClientConnection) -> None:
        socket = inner._live_connections.get(connection.client_id)
        request = None if socket is None else socket.request
        origin = None if request is None else request.headers.get("Origin")
        # Programs send none; browsers always do, and their pages cannot change it.
        if socket is not None and origin is not None and origin not in allowed:
            await socket.close(1008, "pages of other sites may not use the labeler")

    inner._client_connect_cb.insert(0, check)
    return server


def close_server(server: viser.ViserServer) -> None:
    """End a server and its connections."""
    with quietly():
        server.stop()
