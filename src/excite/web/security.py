"""What every request has to pass: the Host, where it comes from, who sends it; and headers.

The page answers to the name it is bound to and no other, so that a foreign name that is
made to point here (DNS rebinding) reads nothing. What changes anything must come from the
page itself, and every browser has a secret that the page's own scripts cannot read. Only the
page's own request makes one, after the token where there is one: whoever is led here by a
link in a foreign page, which no such cookie goes along with, keeps the one he has.
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
"""Wrong tokens in a minute, from one address."""
_MAX_SOURCES = 4096
_LOCAL = ("localhost", "127.0.0.1", "::1")
_OPEN = ("/", "/api/session")
"""What is answered before a token is shown: the page itself, which says nothing, and the door."""
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
    """Refuses what does not come from the page, and hands sessions out."""

    def __init__(self, app: ASGIApp, settings: PageSettings, sessions: Sessions) -> None:
        self._app, self._settings, self._sessions = app, settings, sessions
        self._wrong: dict[str, deque[float]] = {}
        self._names = {settings.host, *_LOCAL}
        if not is_loopback(settings.host):  # looked up once: a name server may be slow
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
        bound = scope.get("server") or ("", port)
        if len(hosts) != 1 or port != bound[1] or not self._is_own(name):
            raise RefusedError(421, "this is not the address that the bench page answers to")

    def _is_own(self, name: str) -> bool:
        host = self._settings.host
        if name in self._names or is_loopback(host):
            return name in self._names
        try:  # a number cannot be made to point elsewhere
            return ipaddress.ip_address(host).is_unspecified and bool(ipaddress.ip_address(name))
        except ValueError:
            return False

    def _session(self, headers: Headers, scope: Scope) -> Session | None:
        """The session whose secret the browser shows."""
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(_cookie(scope))
        except CookieError:
            morsel = None
        return self._sessions.get(morsel.value) if morsel else None

    def _stranger(self) -> RefusedError:
        if self._settings.token is None:
            return RefusedError(403, "this browser is not known here; open the page again")
        return RefusedError(401, "the token is needed; it was printed where the page was started")

    def _enter(self, asked: Asked, scope: Scope) -> str | None:
        """The cookie of a new session; None where the token is needed and was not shown.

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
        # The others' tries do not count: nobody can lock out who knows the token.
        self._wrong = {s: w for s, w in self._wrong.items() if now - w[-1] < 60}
        wrong = self._wrong.get(source, deque(maxlen=MAX_TRIES))
        if len(wrong) == MAX_TRIES and now - wrong[0] < 60:
            raise RefusedError(429, "too many wrong tokens; wait a minute")
        if isinstance(token, str) and hmac.compare_digest(token.encode(), own.encode()):
            return
        wrong.append(now)
        if len(self._wrong) < _MAX_SOURCES:
            self._wrong[source] = wrong
        raise RefusedError(401, "this is not the token")


def _is_open(path: str) -> bool:
    return path in _OPEN or path.startswith("/static/")


def _cookie(scope: Scope) -> str:
    """Its name: cookies are shared by all ports of a computer, and each server has its own."""
    return f"excite_{(scope.get('server') or ('', 0))[1]}"


def _source(scope: Scope) -> str:
    """Where a request comes from; of version 6 the network, for a computer has many of them."""
    address = (scope.get("client") or ("", 0))[0]
    try:
        number = ipaddress.ip_address(address)
    except ValueError:
        return address
    number = getattr(number, "ipv4_mapped", None) or number  # of version 4, to a socket of 6
    return str(ipaddress.ip_network((number, 64 if number.version == 6 else 32), strict=False))


async def _answered(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Passes a request on; a defect is one sentence for the user, the rest for the terminal."""
    is_begun = False

    async def answer(message: Message) -> None:
        nonlocal is_begun
        is_begun = True
        await send(message)

    try:
        await app(scope, receive, answer)
    except ClientDisconnect:  # nobody waits for an answer
        return
    except Exception:
        if is_begun:  # the connection has to break
            raise
        _LOG.exception("a request failed")
        sentence = "the server has failed at this request; its terminal says why"
        await JSONResponse({"sentence": sentence}, 500)(scope, receive, send)


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
