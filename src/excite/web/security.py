"""Checks of every request: Host, origin, session; and headers of every response.

The server answers only to the name to which it is bound, which prevents DNS rebinding. A
request that changes anything must come from the page itself. Every browser has a secret in
a cookie that scripts cannot read. Only a request of the page makes one, after the token if
there is one. A link from another site, which does not send the cookie, does not replace it.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import socket
import time
from collections import deque
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .requests import Asked, RefusedError
from .sessions import PageSettings, Session, Sessions, is_loopback

MAX_TRIES = 10
"""Allowed number of wrong tokens per minute from one address."""
_MAX_SOURCES = 4096
_LOCAL = ("localhost", "127.0.0.1", "::1")
_OPEN = ("/", "/api/session")
"""Paths that need no session: the static page, and the request with the token."""
_LOG = logging.getLogger(__name__)
_HEADERS = {
    "content-security-policy": "default-src 'self'; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """Refuses requests that do not come from the page, and opens sessions."""

    def __init__(self, app: ASGIApp, settings: PageSettings, sessions: Sessions) -> None:
        self._app, self._settings, self._sessions = app, settings, sessions
        self._wrong: dict[str, deque[float]] = {}
        self._names = {settings.host, *_LOCAL}
        if not is_loopback(settings.host):  # looked up once, because a name server may be slow
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or refuses it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        answer = _with_headers(send)
        try:
            headers = Headers(scope=scope)
            self._check_host(headers, scope)
            _check_origin(headers, scope)
            session = self._session(headers, scope)
            if session is None and not _is_open(scope["path"]):
                raise self._stranger()
            scope.setdefault("state", {})["session"] = session
            scope["state"]["enter"] = lambda asked: self._enter(asked, scope)
        except RefusedError as refused:
            refusal = JSONResponse({"sentence": refused.sentence}, refused.status)
            await refusal(scope, receive, answer)
            return
        await _answered(self._app, scope, receive, answer)

    def _check_host(self, headers: Headers, scope: Scope) -> None:
        hosts = headers.getlist("host")
        try:
            parts = urlsplit(f"//{hosts[0]}")
            name, port = (parts.hostname or "").lower(), parts.port or 80
        except (ValueError, IndexError):
            name, port = "", 0
        bound, plain = scope.get("server") or ("", port), f"[{name}]" if ":" in name else name
        exact = [f"{plain}:{port}", *([plain] if port == 80 else [])]  # no user, no other spelling
        is_exact = len(hosts) == 1 and hosts[0].lower() in exact
        if not is_exact or port != bound[1] or not self._is_own(name):
            raise RefusedError(421, "the bench page does not answer to this address")

    def _is_own(self, name: str) -> bool:
        host = self._settings.host
        if name in self._names or is_loopback(host):
            return name in self._names
        try:  # an IP address needs no DNS
            return ipaddress.ip_address(host).is_unspecified and bool(ipaddress.ip_address(name))
        except ValueError:
            return False

    def _session(self, headers: Headers, scope: Scope) -> Session | None:
        """The session of the secret in the browser's cookie."""
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(_cookie(scope))
        except CookieError:
            morsel = None
        return self._sessions.get(morsel.value) if morsel else None

    def _stranger(self) -> RefusedError:
        if self._settings.token is None:
            return RefusedError(403, "this browser has no session; open the page again")
        return RefusedError(401, "the token is needed; `excite serve` printed it")

    def _enter(self, asked: Asked, scope: Scope) -> str | None:
        """The cookie of a new session; None where the token is needed and was not sent.

        Raises:
            RefusedError: for a wrong token, or after too many of them.
        """
        if self._settings.token is not None:
            if "token" not in asked:
                return None
            self._check_token(asked["token"], self._settings.token, _source(scope))
        return f"{_cookie(scope)}={self._sessions.new()}; HttpOnly; SameSite=Strict; Path=/"

    def _check_token(self, token: object, own: str, source: str) -> None:
        now = time.monotonic()
        # Attempts are counted by address, so that a client with the token is not locked out.
        self._wrong = {s: w for s, w in self._wrong.items() if now - w[-1] < 60}
        wrong = self._wrong.get(source, deque(maxlen=MAX_TRIES))
        if len(wrong) == MAX_TRIES and now - wrong[0] < 60:
            raise RefusedError(429, "too many wrong tokens; wait a minute")
        if isinstance(token, str) and hmac.compare_digest(token.encode(), own.encode()):
            return
        wrong.append(now)
        if len(self._wrong) < _MAX_SOURCES:
            self._wrong[source] = wrong
        raise RefusedError(401, "wrong token")


def _is_open(path: str) -> bool:
    return path in _OPEN or path.startswith("/static/")


def _cookie(scope: Scope) -> str:
    """The cookie's name, with the port, because all ports of a computer share cookies."""
    return f"excite_{(scope.get('server') or ('', 0))[1]}"


def _source(scope: Scope) -> str:
    """Address of a request; for IPv6 its network, because a computer has many addresses."""
    address = (scope.get("client") or ("", 0))[0]
    try:
        number = ipaddress.ip_address(address)
    except ValueError:
        return address
    number = getattr(number, "ipv4_mapped", None) or number  # IPv4 on an IPv6 socket
    return str(ipaddress.ip_network((number, 64 if number.version == 6 else 32), strict=False))


async def _answered(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Passes a request on; on an internal error the user gets one sentence, the log the rest."""
    is_begun = False

    async def answer(message: Message) -> None:
        nonlocal is_begun
        is_begun = True
        await send(message)

    try:
        await app(scope, receive, answer)
    except ClientDisconnect:  # the client has left
        return
    except Exception:
        if is_begun:  # the connection has to break
            raise
        _LOG.exception("a request failed")
        sentence = "the server failed at this request; its terminal shows the reason"
        await JSONResponse({"sentence": sentence}, 500)(scope, receive, send)


def _check_origin(headers: Headers, scope: Scope) -> None:
    """Raises RefusedError where a request that changes or computes is not from the page."""
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
