"""Apply the access control to viser's connections: check each new one, and filter what it sends."""

from __future__ import annotations

import asyncio
import logging
import time as clock
from collections import defaultdict
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from .access_control import MAX_BROWSERS, MAX_MESSAGE_BYTES, RateLimit, is_trusted, is_valid_message

if TYPE_CHECKING:
    import viser


class ConnectionFilter:
    """Filters all incoming connections and messages of a server."""

    def __init__(self, server: viser.ViserServer, host: str, accepts: Callable[[str, Any], bool]) -> None:
        """Install the filter.

        Args:
            host: address that the server listens on.
            accepts: whether the control with this id can have this value.
        """
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # it logs a traceback for each malformed request
        self._socket, self._host, self._accepts = server._websock_server, host, accepts
        self._socket._handle_incoming_message = self._filtered(self._socket._handle_incoming_message)
        self._socket.on_client_connect(self._admit)
        for client_id in tuple(self._open):  # connected before the line above
            asyncio.run_coroutine_threadsafe(self._check_connection(client_id), server._event_loop)

    @property
    def _open(self) -> dict[int, Any]:
        """Open connections of viser, by client id."""
        return self._socket._live_connections

    async def _admit(self, connection: Any) -> None:
        """Check a new connection before anything is sent or read."""
        connection._handle_incoming_message = self._filtered(connection._handle_incoming_message)
        await self._check_connection(connection.client_id)

    async def _check_connection(self, client_id: int) -> None:
        """Close connections of foreign pages, and those beyond `MAX_BROWSERS`."""
        if (connection := self._open.get(client_id)) is None:
            return
        connection.protocol.max_message_size = MAX_MESSAGE_BYTES
        if not self._is_trusted(client_id):
            await connection.close(1008, "not this viewer's page")
        elif len(self._open) > MAX_BROWSERS:
            await connection.close(1013, "too many browsers")

    def _is_trusted(self, client_id: int) -> bool:
        """Whether to serve an open connection."""
        connection = self._open.get(client_id)
        if connection is None:
            return False
        origins, hosts = (connection.request.headers.get_all(name) for name in ("Origin", "Host"))
        return len(origins) < 2 and is_trusted(next(iter(origins), None), next(iter(hosts), None), self._host)

    def _filtered(self, handle: Callable[[int, Any], Awaitable[None]]) -> Callable[[int, Any], Awaitable[None]]:
        """A version of `handle` that drops invalid messages and foreign pages, and closes a connection that floods."""
        paces: defaultdict[int, RateLimit] = defaultdict(RateLimit)

        async def filtered(client_id: int, message: Any) -> None:
            kind, fields = type(message).__name__, vars(message)
            connection = self._open.get(client_id)
            if connection is None:
                paces.pop(client_id, None)
            elif paces[client_id].exceeded(clock.monotonic()):
                connection.transport.abort()
            elif self._is_trusted(client_id) and is_valid_message(kind, fields, self._accepts):
                await handle(client_id, message)

        return filtered
