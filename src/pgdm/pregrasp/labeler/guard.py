"""Keeps other machines, and pages of other sites, away from the labeler's server.

This is the only module that uses viser's private interface, which may change with any version.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import rich
import viser
from viser.infra import WebsockClientConnection

from pgdm.errors import PgdmError

HOST = "127.0.0.1"
"""The server listens on this machine only, because the page has no password."""
VISER = "1.1.1"
"""Version of viser whose private interface :func:`secure` was checked against."""
_TUNNELS = ("ShareUrlRequest", "ShareUrlDisconnect")
"""Messages with which a page asks the server to open or close a public tunnel to the server."""


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Suppress viser's messages on the terminal inside the context."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def open_server(port: int) -> viser.ViserServer:
    """Start a server on this machine that refuses pages of other sites.

    Args:
        port: port to listen on; if it is taken, viser uses the next free one.

    Raises:
        PgdmError: the installed viser cannot be secured.
    """
    with quietly():
        server = viser.ViserServer(HOST, port, label="pgdm labeler", verbose=False)
    try:
        secure(server)
    except PgdmError:
        close_server(server)
        raise
    return server


def secure(server: viser.ViserServer) -> None:
    """Make a server refuse tunnels and connections from pages of other sites.

    By default viser accepts connections from any page that the user's browser shows, and opens a
    public tunnel if such a page requests it.

    Raises:
        PgdmError: the private interface of the installed viser differs from the expected one.
    """
    inner: Any = getattr(server, "_websock_server", None)
    handlers, callbacks, connections = (
        getattr(inner, name, None)
        for name in ("_incoming_handlers", "_client_connect_cb", "_live_connections")
    )
    if (
        not isinstance(handlers, dict)
        or not isinstance(callbacks, list)
        or not isinstance(connections, dict)
        or not set(_TUNNELS) <= {message.__name__ for message in handlers}
    ):
        raise PgdmError(
            f"viser {viser.__version__} cannot be restricted to this machine's page: its private "
            f"interface differs from that of {VISER}; install it with 'pip install viser=={VISER}'"
        )
    for message in [message for message in handlers if message.__name__ in _TUNNELS]:
        del handlers[message]
    allowed = {f"http://{name}:{server.get_port()}" for name in (HOST, "localhost")}

    async def check(connection: WebsockClientConnection) -> None:
        # Browsers always send the page's origin, which the page cannot change; other programs on
        # this machine send none and may connect. If the connection is not found, the KeyError makes
        # viser close it.
        socket = connections[connection.client_id]
        origin = socket.request.headers.get("Origin")
        if origin is not None and origin not in allowed:
            await socket.close(1008, "pages of other sites may not use the labeler")

    callbacks.insert(0, check)


def close_server(server: viser.ViserServer) -> None:
    """Stop a server and close its connections."""
    with quietly():
        server.stop()
