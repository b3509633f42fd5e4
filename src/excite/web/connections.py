"""Connections to the server: how many may be silent, and how long a request may take to come."""

from __future__ import annotations

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_SILENT = 256
"""Connections that ask nothing; the oldest of more is closed."""
PATIENCE = 10.0
"""Seconds until the head of a request must be complete, and the longest pause in its body."""


class Connection(H11Protocol):
    """One that is closed where no request comes, before anything is known of who it is."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Takes a new connection; the oldest silent one makes room."""
        super().connection_made(transport)
        self._since = self._heard = self.loop.time()
        self._timer = self.loop.call_later(PATIENCE, self._look)
        silent = [c for c in self.connections if isinstance(c, Connection) and c.is_silent]
        if len(silent) > MAX_SILENT:
            min(silent, key=lambda c: c._since).transport.close()

    @property
    def is_silent(self) -> bool:
        """Whether no complete head of a request has come since the last answer."""
        return self.conn.their_state is h11.IDLE and not self.transport.is_closing()

    def data_received(self, data: bytes) -> None:
        """Takes a part of a request."""
        self._heard = self.loop.time()
        super().data_received(data)

    def on_response_complete(self) -> None:
        """The next request may come."""
        self._since = self.loop.time()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends the connection."""
        self._timer.cancel()
        super().connection_lost(exc)

    def _look(self) -> None:
        """Closes the connection if it waited too long."""
        last = self._since if self.is_silent else self._heard
        is_awaited = self.is_silent or self.conn.their_state is h11.SEND_BODY
        if is_awaited and self.loop.time() - last >= PATIENCE:
            self.transport.close()
        else:
            self._timer = self.loop.call_later(PATIENCE / 4, self._look)
