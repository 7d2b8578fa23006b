"""`femoreg review RUN`: a person looks at a registration, and accepts or rejects it."""

from pathlib import Path


def review(run: Path, *, case: Path | None = None, port: int = 0) -> None:
    """Show the report of a registration on a local page, where a person accepts or rejects it with a note.

    The page is served to this machine alone, under an address with a secret token, which is printed. The decision is
    written to RUN/review.json; the verdict stays as it is. Ctrl-C ends it.

    Args:
        run: Folder that `femoreg register` wrote.
        case: Case folder, if it no longer stands where it stood, seen from RUN, when it was registered.
        port: Port of 127.0.0.1 to listen on; by default a free one.
    """
    import secrets
    import socket

    from rich.console import Console

    from femoreg_torch.case import read_case, read_result
    from femoreg_torch.case.review import read_review, result_sha256
    from femoreg_torch.commands.replay import case_of
    from femoreg_torch.errors import InputError
    from femoreg_torch.evaluation import evaluation_page
    from femoreg_torch.review import review_app, serve
    from femoreg_torch.review.server import LOOPBACK

    console = Console()
    digest, result = result_sha256(run), read_result(run)
    read_review(run)  # a file that is none is complained of now
    with console.status("drawing the report"):
        page = evaluation_page(read_case(case_of(run, result, case)), result)
    with socket.socket() as listening:
        try:
            listening.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            raise InputError(
                f"--port {port}: cannot listen there ({error}). Leave it out to take a free one."
            ) from error
        token = secrets.token_urlsafe(24)
        address = f"http://{LOOPBACK}:{listening.getsockname()[1]}/{token}/"
        console.print(f"Review at {address} (Ctrl-C ends it)", soft_wrap=True, markup=False, highlight=False)
        serve(review_app(run, result, page, digest, token), listening)
