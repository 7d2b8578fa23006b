"""The local server of a review: its page, the state that the page asks for, and what the page may change.

Who may ask: only this machine (the server listens on the loopback address alone), only under a host name of this
machine (so that no web page reaches it under a name of its own, by DNS rebinding), only with the token in the address,
and changes only from the page itself. Pages load nothing from outside, and no request names a file.
"""

import hmac
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from datetime import UTC, datetime
from urllib.parse import parse_qs

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from femoreg_torch.case.review import Decision
from femoreg_torch.errors import InputError
from femoreg_torch.review.desk import Change, Desk, RefusedError, Source
from femoreg_torch.review.page import review_page
from femoreg_torch.settings import read_record
from femoreg_torch.text import json_content

LOOPBACK = "127.0.0.1"
_HOSTS = [LOOPBACK, "localhost"]
_MOST_BYTES = 40_000  # of a request
_JSON = "application/json"
_SOURCES: tuple[Source, ...] = ("landmarks", "objects", "network")
# With the policy `no-referrer` browsers would hide where a decision comes from, from this server too.
_HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "same-origin", "X-Content-Type-Options": "nosniff"}
Handler = Callable[[Request], Awaitable[Response]]


def review_app(desk: Desk, token: str) -> Starlette:
    """The application of one review."""

    def guarded(answer: Handler) -> Handler:
        """An answer for those alone who know the token, and, to changes, those alone that come from the page."""

        async def checked(request: Request) -> Response:
            given = str(request.path_params["token"])
            if not hmac.compare_digest(given.encode(), token.encode()):
                return _told("Wrong address: open the one that `femoreg review` printed.", 403)
            origin = request.headers.get("origin")
            if request.method == "POST" and origin is not None and origin != f"http://{request.headers['host']}":
                return _told("This request comes from another page.", 403)
            return await answer(request)

        return checked

    async def page(message: str = "", status: int = 200) -> Response:
        text, policy = await run_in_threadpool(review_page, desk, message)
        return HTMLResponse(text, status, {**_HEADERS, "Content-Security-Policy": policy})

    async def show(_: Request) -> Response:
        return await page()

    async def show_report(_: Request) -> Response:
        try:
            text = await run_in_threadpool(desk.report)
        except RefusedError as error:
            return _told(str(error), 404)
        return HTMLResponse(text, headers={**_HEADERS, "Content-Security-Policy": "frame-ancestors 'self'"})

    async def state(_: Request) -> Response:
        return JSONResponse(await run_in_threadpool(desk.state), headers=_HEADERS)

    async def drawing(_: Request) -> Response:
        return JSONResponse(await run_in_threadpool(desk.drawing), headers=_HEADERS)

    async def change(request: Request) -> Response:
        return await carried_out(request, lambda content: desk.change(read_record(Change, content, "change")))

    async def start(request: Request) -> Response:
        def begin(content: dict[str, object]) -> None:
            source = next((source for source in _SOURCES if source == content.get("source")), None)
            revision = content.get("revision")
            if source is None or not isinstance(revision, int):
                raise InputError(f"start: a source ({', '.join(_SOURCES)}) and a revision were expected.")
            desk.start(source, revision)

        return await carried_out(request, begin)

    async def cancel(request: Request) -> Response:
        return await carried_out(request, lambda _: desk.cancel())

    async def carried_out(request: Request, act: Callable[[dict[str, object]], None]) -> Response:
        """Do what a request asks for, and answer with the state and drawing after it, and what was wrong, in words."""
        if request.headers.get("content-type", "").partition(";")[0] != _JSON:
            return _told(f"{_JSON} was expected.", 415)
        body = await _body(request)
        if body is None:
            return _told("This request is too long.", 413)

        def done() -> tuple[str, int]:
            try:
                content = json_content(body, "request")
                if not isinstance(content, dict):
                    raise InputError("request: a JSON object was expected.")
                act(content)
            except RefusedError as error:
                return str(error), 409
            except InputError as error:
                return str(error), 400
            return "", 200

        message, status = await run_in_threadpool(done)
        shown = await run_in_threadpool(desk.drawing)
        return JSONResponse({**shown, "message": message}, status, _HEADERS)

    async def decide(request: Request) -> Response:
        body = await _body(request)
        if body is None:
            return _told("This decision is too long.", 413)
        fields = {key: values[-1].strip() for key, values in parse_qs(body.decode("utf-8", "replace")).items()}
        if message := _complaint(fields):
            return await page(message, 400)
        decision: Decision = "accepted" if fields["decision"] == "accepted" else "rejected"
        now = datetime.now(UTC).isoformat(timespec="microseconds")
        showed = fields.get("result", ""), fields.get("before", "")
        try:
            await run_in_threadpool(
                desk.decide, decision, fields.get("note", ""), fields["reviewer"], now, showed[0], showed[1]
            )
        except RefusedError as error:
            return await page(str(error), 409)
        return RedirectResponse(f"/{token}/", 303, _HEADERS)

    return Starlette(
        routes=[
            Route("/{token}/", guarded(show)),
            Route("/{token}/report", guarded(show_report)),
            Route("/{token}/state", guarded(state)),
            Route("/{token}/drawing", guarded(drawing)),
            Route("/{token}/change", guarded(change), methods=["POST"]),
            Route("/{token}/start", guarded(start), methods=["POST"]),
            Route("/{token}/cancel", guarded(cancel), methods=["POST"]),
            Route("/{token}/decision", guarded(decide), methods=["POST"]),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=_HOSTS, www_redirect=False)],
    )


def _told(words: str, status: int) -> Response:
    return PlainTextResponse(words, status, _HEADERS)


async def _body(request: Request) -> bytes | None:
    """The body of a request, None if it is too long."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_BYTES:
            return None
    return body


def _complaint(fields: dict[str, str]) -> str:
    """What is wrong with a decision, in words; empty if nothing is."""
    if fields.get("decision") not in ("accepted", "rejected"):
        return "Nothing was written: accept or reject."
    if not fields.get("reviewer"):
        return "Nothing was written: your name is missing."
    if fields["decision"] == "rejected" and not fields.get("note"):
        return "Nothing was written: say in the note why you reject it."
    return ""


def serve(app: Starlette, listening: socket.socket) -> None:
    """Serve until the user stops it, on a socket that listens already."""
    with suppress(KeyboardInterrupt):  # Ctrl-C is how a review ends
        uvicorn.Server(uvicorn.Config(app, log_level="error", server_header=False)).run(sockets=[listening])
