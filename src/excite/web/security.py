"""What every request has to pass: the Host, where it comes from, who sends it; and headers.

The page answers to the name it is bound to and no other, so that a foreign name that is
made to point here (DNS rebinding) reads nothing. What changes anything must come from the
page itself, and every browser has a secret that the page's own scripts cannot read.
"""

from __future__ import annotations

import hmac
import ipaddress
import socket
import time
from collections import deque
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .base import RefusedError, Session, Sessions, Settings

MAX_TRIES = 10
"""Wrong tokens in a minute, from everywhere together."""
_LOCAL = ("localhost", "127.0.0.1", "::1")
_OPEN = ("/", "/api/session")
"""What is answered before a token is shown: the page itself, which says nothing."""
_HEADERS = {
    "content-security-policy": "default-src 'self'; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


def is_loopback(host: str) -> bool:
    """Whether an address is of this computer alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """Refuses what does not come from the page, and hands sessions out."""

    def __init__(self, app: ASGIApp, settings: Settings, sessions: Sessions) -> None:
        self._app, self._settings, self._sessions = app, settings, sessions
        self._wrong: deque[float] = deque()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or refuses it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        answer, cookie = _with_headers(send), None
        try:
            headers = Headers(scope=scope)
            self._check_host(headers, scope)
            _check_origin(headers, scope)
            if scope["path"].startswith("/static/"):
                await self._app(scope, receive, answer)
                return
            session, cookie = self._session(headers, scope)
            self._check_known(session, scope)
            scope.setdefault("state", {})["session"] = session
            scope["state"]["show_token"] = lambda token: self._show_token(session, token)
        except RefusedError as refused:
            refusal = JSONResponse({"sentence": refused.sentence}, refused.status)
            await refusal(scope, receive, answer)
            return
        await self._app(scope, receive, _with_cookie(answer, cookie) if cookie else answer)

    def _check_host(self, headers: Headers, scope: Scope) -> None:
        hosts = headers.getlist("host")
        try:
            parts = urlsplit(f"//{hosts[0]}")
            name, port = (parts.hostname or "").lower(), parts.port or 80
        except (ValueError, IndexError):
            name, port = "", 0
        bound = scope.get("server") or ("", port)
        if len(hosts) != 1 or port != bound[1] or not self._is_own(name):
            raise RefusedError(421, "this is not the address that the bench page answers to")

    def _is_own(self, name: str) -> bool:
        host = self._settings.host
        if is_loopback(host):
            return name in (*_LOCAL, host)
        if name in (host, *_LOCAL, socket.gethostname().lower(), socket.getfqdn().lower()):
            return True
        try:  # a number cannot be made to point elsewhere
            return ipaddress.ip_address(host).is_unspecified and bool(ipaddress.ip_address(name))
        except ValueError:
            return False

    def _session(self, headers: Headers, scope: Scope) -> tuple[Session, str | None]:
        """The browser's session; a new one, and its cookie, where the page is opened."""
        # Cookies are shared by all ports of a computer: each server has a name of its own.
        name = f"excite_{(scope.get('server') or ('', 0))[1]}"
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(name)
        except CookieError:
            morsel = None
        session = self._sessions.get(morsel.value) if morsel else None
        if session is not None:
            return session, None
        # Nor does a picture in a foreign page, that is not one, make sessions.
        if scope["path"] != "/" or headers.get("sec-fetch-dest") not in (None, "document"):
            raise RefusedError(403, "this browser is not known here; open the page again")
        secret, session = self._sessions.new()
        return session, f"{name}={secret}; HttpOnly; SameSite=Strict; Path=/"

    def _check_known(self, session: Session, scope: Scope) -> None:
        if self._settings.token is None or session.is_known:
            return
        if scope["path"] not in _OPEN:
            raise RefusedError(
                401, "the token is needed; it was printed where the page was started"
            )

    def _show_token(self, session: Session, token: object) -> None:
        """Lets a browser in that knows the token.

        Raises:
            RefusedError: for another, or after too many others.
        """
        now = time.monotonic()
        while self._wrong and now - self._wrong[0] > 60:
            self._wrong.popleft()
        if len(self._wrong) >= MAX_TRIES:
            raise RefusedError(429, "too many wrong tokens; wait a minute")
        own = (self._settings.token or "").encode()
        if not (isinstance(token, str) and hmac.compare_digest(token.encode(), own)):
            self._wrong.append(now)
            raise RefusedError(401, "this is not the token")
        session.is_known = True


def _check_origin(headers: Headers, scope: Scope) -> None:
    """What changes something, or costs something, is asked for by the page itself."""
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    own = f"http://{headers.get('host', '')}"
    if scope["method"] in ("GET", "HEAD"):
        is_foreign = scope["path"].startswith("/api/") and site not in (None, "same-origin", "none")
    else:
        is_foreign = origin != own or site not in (None, "same-origin")
    if is_foreign:
        raise RefusedError(403, "this request does not come from the bench page")


def _with_headers(send: Send) -> Send:
    async def answer(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return answer


def _with_cookie(send: Send, cookie: str) -> Send:
    async def answer(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).append("set-cookie", cookie)
        await send(message)

    return answer
