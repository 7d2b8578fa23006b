"""A registration in a process of its own, what it tells while it runs, and its end."""

import multiprocessing
import pickle
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock, Thread
from typing import Any, Literal

import torch

from femoreg_torch.errors import InputError, defect_in_one_line
from femoreg_torch.geometry import Poses

State = Literal["running", "done", "refused", "failed", "cancelled"]
Report = Callable[[str, float], None]
Follow = Callable[[Poses], None]
_KILLED = "Its process was killed, perhaps for lack of memory. Nothing was written."
_CANCELLED = "Cancelled. Nothing was written."


@dataclass(frozen=True)
class Order:
    """What is registered, how, and from where: as the arguments of `femoreg register`."""

    case: Path
    out: Path
    preset: str
    seed: int
    device: str
    weights: Path | None = None
    landmarks: Path | None = None
    start: Path | None = None


Work = Callable[[Order, Report, Follow], None]  # registers and writes the run; raises `InputError`


@dataclass(frozen=True, eq=False)
class Progress:
    """How far a registration is."""

    state: State
    step: str = ""
    share: float = 0.0  # of the plan, 0 to 1
    words: str = ""  # why it ended
    poses: Poses | None = None  # after the last optimisation
    moment: int = 0  # how often poses were told


class Registration:
    """One registration in a process of its own, which ends with this one.

    Python's `spawn` starts the process, so `work` must be a function of a module.
    """

    def __init__(self, work: Work, order: Order) -> None:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe(duplex=False)
        self._lock = Lock()
        self._progress = Progress("running", "starting")
        self._process = context.Process(target=_child, args=(work, order, there), daemon=True)
        self._process.start()
        there.close()  # so that its end is seen here
        self._listener = Thread(target=self._listen, args=(here,), daemon=True)
        self._listener.start()

    @property
    def progress(self) -> Progress:
        """How far it is."""
        with self._lock:
            return self._progress

    def cancel(self) -> None:
        """Kill it, and wait until it is gone. What it had not finished writing is not there."""
        with self._lock:
            if self._progress.state == "running":
                self._progress = Progress("cancelled", words=_CANCELLED)
        self._process.kill()
        self._process.join()
        self._listener.join()

    def _listen(self, pipe: Connection) -> None:
        with pipe:
            while True:
                try:
                    told = pickle.loads(pipe.recv_bytes())  # of our own process
                except EOFError:
                    break
                self._change(told)
        self._process.join()
        self._change({"state": "failed", "words": _KILLED})

    def _change(self, told: dict[str, Any]) -> None:
        """What was told, unless it has ended already."""
        if "poses" in told:
            cameras, objects, changes = told["poses"]
            poses = {name: torch.from_numpy(pose) for name, pose in objects.items()}
            told = {"poses": Poses(torch.from_numpy(cameras), poses, changes)}
        with self._lock:
            if self._progress.state == "running":
                moment = self._progress.moment + ("poses" in told)
                self._progress = replace(self._progress, **told, moment=moment)


def _child(work: Work, order: Order, pipe: Connection) -> None:
    """Carry out an order and tell all of it through the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one, and ends it

    def tell(**told: Any) -> None:
        pipe.send_bytes(pickle.dumps(told))

    def report(step: str, share: float) -> None:
        tell(step=step, share=share)

    def follow(poses: Poses) -> None:
        objects = {name: pose.numpy() for name, pose in poses.camera1_from.items()}
        tell(poses=(poses.camera_from_camera1.numpy(), objects, poses.changes))

    try:
        work(order, report, follow)
    except (InputError, OSError) as error:
        tell(state="refused", words=" ".join(str(error).split()))
    except Exception as error:  # a defect: told with its place, and the review goes on
        tell(state="failed", words=defect_in_one_line(error))
    else:
        tell(state="done", share=1.0)
