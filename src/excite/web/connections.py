"""Connections to the server: how many may be silent, and for how long."""

from __future__ import annotations

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_SILENT = 256
"""Connections that ask nothing; the oldest of more is closed."""
PATIENCE = 10.0
"""Seconds that a connection may be silent."""


class Connection(H11Protocol):
    """One that is closed where no request comes, before anything is known of who it is."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Takes a new connection; the oldest silent one makes room."""
        super().connection_made(transport)
        self._since = self.loop.time()
        self._timer = self.loop.call_later(PATIENCE, self._look)
        silent = [c for c in self.connections if isinstance(c, Connection) and c.is_silent]
        if len(silent) > MAX_SILENT:
            min(silent, key=lambda c: c._since).transport.close()

    @property
    def is_silent(self) -> bool:
        """Whether no head of a request has come, or the last request is answered already."""
        asks_nothing = self.conn.their_state is h11.IDLE or self.conn.our_state is h11.DONE
        return asks_nothing and not self.transport.is_closing()

    def data_received(self, data: bytes) -> None:
        """Takes a part of a request; those of a head do not prolong it."""
        if self.conn.their_state is not h11.IDLE:
            self._since = self.loop.time()
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
        """Closes the connection if it was silent for too long."""
        if self.is_silent and self.loop.time() - self._since >= PATIENCE:
            self.transport.close()
        else:
            self._timer = self.loop.call_later(PATIENCE / 4, self._look)
