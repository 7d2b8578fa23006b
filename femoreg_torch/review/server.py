"""The local server of a review: the report of a run beside a form that accepts or rejects it.

Who may ask: only this machine (the server listens on the loopback address alone), only under a host name of this
machine (so that no web page reaches it under a name of its own, by DNS rebinding), only with the token in the address,
and a decision only from the page itself. Pages load nothing from outside.
"""

import hmac
import socket
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import parse_qs

import jinja2
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from femoreg_torch.case import Result
from femoreg_torch.case.review import Decision, Review, read_review, result_sha256, write_review
from femoreg_torch.navigation.report import NOTICE

LOOPBACK = "127.0.0.1"
_HOSTS = [LOOPBACK, "localhost"]
_MOST_BYTES = 40_000  # of a decision
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-src 'self'; form-action 'self'; "
    "frame-ancestors 'none'; base-uri 'none'"
)
# With the policy `no-referrer` browsers would hide where a decision comes from, from this server too.
_HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "same-origin", "X-Content-Type-Options": "nosniff"}


def review_app(run: Path, result: Result, report: str, digest: str, token: str) -> Starlette:
    """The application for one run.

    `report` is the page of its `result`, and `digest` that of the result.json that the page was made from: a decision
    is refused once another result stands there.
    """
    template = jinja2.Environment(
        loader=jinja2.PackageLoader("femoreg_torch.review"), autoescape=True, undefined=jinja2.StrictUndefined
    ).get_template("review.html")

    def refused(request: Request) -> Response | None:
        given = str(request.path_params["token"])
        if hmac.compare_digest(given.encode(), token.encode()):
            return None
        return PlainTextResponse("Wrong address: open the one that `femoreg review` printed.", 403, _HEADERS)

    def page(message: str = "", status: int = 200) -> Response:
        text = template.render(
            name=run.resolve().name,
            verdict=result.verdict,
            review=read_review(run),
            current=digest,
            changed=result_sha256(run) != digest,
            message=message,
            notice=NOTICE,
        )
        return HTMLResponse(text, status, {**_HEADERS, "Content-Security-Policy": _POLICY})

    def show(request: Request) -> Response:
        return refused(request) or page()

    def show_report(request: Request) -> Response:
        frame = {"Content-Security-Policy": "frame-ancestors 'self'"}
        return refused(request) or HTMLResponse(report, headers={**_HEADERS, **frame})

    async def decide(request: Request) -> Response:
        if (answer := refused(request)) is not None:
            return answer
        origin = request.headers.get("origin")
        if origin is not None and origin != f"http://{request.headers['host']}":
            return PlainTextResponse("This decision comes from another page.", 403, _HEADERS)
        body = b""
        async for chunk in request.stream():
            body += chunk
            if len(body) > _MOST_BYTES:
                return PlainTextResponse("This decision is too long.", 413, _HEADERS)
        fields = {key: values[-1].strip() for key, values in parse_qs(body.decode("utf-8", "replace")).items()}
        message = _complaint(fields)
        if message:
            return page(message, 400)
        before = read_review(run)
        if result_sha256(run) != digest:
            return page("Nothing was written: the result has changed since. Start the review again.", 409)
        if fields.get("before", "") != ("" if before is None else before.time):
            return page("Nothing was written: somebody has decided meanwhile, see above. Decide again.", 409)
        decision: Decision = "accepted" if fields["decision"] == "accepted" else "rejected"
        now = datetime.now(UTC).isoformat(timespec="microseconds")
        write_review(run, Review(decision, fields.get("note", ""), fields["reviewer"], now, digest))
        return RedirectResponse(f"/{token}/", 303, _HEADERS)

    return Starlette(
        routes=[
            Route("/{token}/", show),
            Route("/{token}/report", show_report),
            Route("/{token}/decision", decide, methods=["POST"]),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=_HOSTS, www_redirect=False)],
    )


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
    uvicorn.Server(uvicorn.Config(app, log_level="error", server_header=False)).run(sockets=[listening])
