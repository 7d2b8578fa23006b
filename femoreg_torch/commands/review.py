"""`femoreg review CASE|RUN`: a person looks at a registration, starts it anew, and accepts or rejects it."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from femoreg_torch.review import Order
    from femoreg_torch.review.running import Follow, Report

_LAST_PORT = 65535


def review(
    folder: Path,
    *,
    case: Path | None = None,
    out: Path | None = None,
    preset: str = "fast",
    seed: int = 0,
    weights: Path | None = None,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
    port: int = 0,
) -> None:
    """Show a case or a run on a local page: place landmarks and objects, register from there, accept or reject.

    The images are shown with the edges of the objects. Landmarks and objects can be dragged; a registration starts from
    either, as `femoreg register` would with `--landmarks` or `--start`, and is watched while it runs. What is placed is
    kept beside the run, RUN.landmarks.csv and RUN.start.json, until it is registered. The page is served to this
    machine alone, under an address with a secret token, which is printed. A decision is written to RUN/review.json; the
    verdict stays as it is. Ctrl-C ends it, and a registration that is under way.

    Args:
        folder: Folder that `femoreg register` wrote, or a case folder.
        case: Case folder of a run, if it no longer stands where it stood, seen from the run, when it was registered.
        out: Folder to write results to, for a case. Those of a run are written to it, and replace its own.
        preset: Workflow, see `femoreg register`.
        seed: Of the random searches.
        weights: Weights of the landmark network, if not those shipped (safetensors).
        device: Where registrations compute: cpu, cuda (the first GPU), or auto, a GPU where there is one.
        port: Port of 127.0.0.1 to listen on, up to 65535; 0 takes a free one.
    """
    import secrets
    import socket

    from rich.console import Console

    from femoreg_torch.case import read_case
    from femoreg_torch.commands.telling import tell_device
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import check_new_folder
    from femoreg_torch.registration import load_plan, prepare_scene
    from femoreg_torch.review import LOOPBACK, Desk, Order, only_review, review_app, serve

    if not 0 <= port <= _LAST_PORT:
        raise InputError(f"--port: 0 to {_LAST_PORT} was expected, found {port}.")
    console = Console()
    of, run = _case_and_run(folder, case, out)
    place = tell_device(console, device)
    load_plan(preset)  # what is wrong with it is told now
    check_new_folder(run, of)
    with only_review(run), socket.socket() as listening:
        try:
            listening.bind((LOOPBACK, port))
            listening.listen()  # or who opens the address at once is refused
        except (OSError, OverflowError) as error:
            raise InputError(
                f"--port {port}: cannot listen there ({error}). Leave it out to take a free one."
            ) from error
        if not console.is_interactive:
            console.print("Reading the case; the address comes next.")
        with console.status("reading the case"):
            read = read_case(of)
            desk = Desk(read, prepare_scene(read), Order(of, run, preset, seed, str(place), weights), register_order)
        token = secrets.token_urlsafe(24)
        address = f"http://{LOOPBACK}:{listening.getsockname()[1]}/{token}/"
        console.print(f"Review at {address} (Ctrl-C ends it)", soft_wrap=True, markup=False, highlight=False)
        try:
            serve(review_app(desk, token), listening)
        finally:
            desk.close()
        console.print("Review ended.")


def _case_and_run(folder: Path, case: Path | None, out: Path | None) -> tuple[Path, Path]:
    """The case, and the folder of its run. Raises `InputError` where either is not told."""
    from femoreg_torch.case import RESULT_NAME, case_folder, read_result
    from femoreg_torch.commands.replay import case_of
    from femoreg_torch.errors import InputError

    if (folder / RESULT_NAME).exists():
        if out is not None:
            raise InputError(
                f"--out: {folder} is a run, and what is registered replaces it. Copy it to keep it as it is."
            )
        return case_of(folder, read_result(folder), case), folder
    folder = case_folder(folder)
    if not (folder / "case.yaml").exists():
        raise InputError(
            f"{folder}: neither a run nor a case, it holds no {RESULT_NAME} and no case.yaml. Name the folder of one."
        )
    if case is not None:
        raise InputError(f"--case: {folder} is a case itself. Leave it out.")
    if out is None:
        raise InputError(f"{folder}: is a case. Name the folder to write the result to with --out.")
    return folder, out


def register_order(order: "Order", report: "Report", follow: "Follow") -> None:
    """Register as ordered, in a process that ends with the one that started it."""
    import torch

    from femoreg_torch.case import read_case
    from femoreg_torch.commands.batch import end_with_parent
    from femoreg_torch.commands.register import register_into

    end_with_parent()
    register_into(
        order.out,
        read_case(order.case),
        order.preset,
        order.seed,
        weights=order.weights,
        landmarks=order.landmarks,
        start=order.start,
        device=torch.device(order.device),
        report=report,
        follow=follow,
    )
