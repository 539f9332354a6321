"""In front of all endpoints: the same-origin check, and headers that make browsers careful."""

from __future__ import annotations

from http import HTTPStatus
from urllib.parse import urlsplit

from fastapi.security.utils import get_authorization_scheme_param
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.errors import problem

_SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS", "TRACE"})


def is_same_origin(headers: Headers) -> bool:
    """Whether a browser's request with side effects comes from our own pages.

    Browsers set Sec-Fetch-Site and Origin themselves and pages cannot forge them. A request that
    carries a cookie but neither of the two is refused; scripts use tokens, which no browser adds
    by itself.
    """
    site = headers.get("sec-fetch-site")
    if site is not None:
        return site in ("same-origin", "none")
    origin = headers.get("origin")
    if origin is not None:
        return urlsplit(origin).netloc == headers.get("host")
    return "cookie" not in headers


def has_token(headers: Headers) -> bool:
    """Whether the request carries a bearer token, which then counts instead of any cookie.

    Other credentials prove nothing: behind a proxy that asks for a password, browsers add
    `Authorization: Basic …` to other sites' requests, too.
    """
    scheme, token = get_authorization_scheme_param(headers.get("authorization"))
    return scheme.lower() == "bearer" and token != ""


class SameOriginGuard:
    """Answers 403 to unsafe requests that another site's page may have triggered."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] not in _SAFE_METHODS:
            headers = Headers(scope=scope)
            if not has_token(headers) and not is_same_origin(headers):
                answer = problem(
                    HTTPStatus.FORBIDDEN,
                    "this request does not come from this site's own pages"
                    " (Sec-Fetch-Site or Origin); scripts use bearer tokens instead of cookies",
                )
                await answer(scope, receive, send)
                return
        await self.app(scope, receive, send)


class CarefulBrowsers:
    """Adds headers: believe the stated content type, tell other sites nothing."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("X-Content-Type-Options", "nosniff")
                headers.setdefault("Referrer-Policy", "same-origin")
            await send(message)

        await self.app(scope, receive, send_with_headers)
