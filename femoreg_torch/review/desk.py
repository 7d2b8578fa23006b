"""The state of one review: what is placed, the run that is looked at, and the registration that is under way."""

from dataclasses import dataclass, replace
from threading import Lock
from typing import Any, Literal

from femoreg_torch.case import RESULT_NAME, Case, Result, read_result
from femoreg_torch.case.review import Decision, Review, read_review, result_sha256, write_review
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import evaluation_page
from femoreg_torch.evaluation.fit import check_fits
from femoreg_torch.registration import Scene
from femoreg_torch.registration.run import network_detector
from femoreg_torch.registration.start.find import look_at
from femoreg_torch.review.drawing import Edges, drawing, pictures
from femoreg_torch.review.kept import forget, keep_landmarks, keep_poses, landmarks_path, start_path, with_kept
from femoreg_torch.review.placing import Mark, Move, Placed, by_landmarks, marked, moved, placed_at_first, unmarked
from femoreg_torch.review.running import Order, Registration, Work

Source = Literal["landmarks", "objects", "network"]
_BUSY = "A registration is running, started from this page or from another one. Wait for it, or cancel it."
_MEANWHILE = "Somebody changed this on another page meanwhile. It is shown now; do it again if you still want to."


class RefusedError(Exception):
    """A request that does not fit what is going on, in words for a person."""


@dataclass(frozen=True)
class Change:
    """One change of what is placed, made on a page that showed the state of `revision`. One of the others is given."""

    revision: int
    move: Move | None = None
    mark: Mark | None = None
    unmark: str | None = None
    do: Literal["find", "place", "reset"] | None = None


@dataclass(frozen=True, eq=False)
class Reviewed:
    """A result, and the digest of the file that it was read from."""

    result: Result
    digest: str


class Desk:
    """What the requests of all pages share. Every method may be called from any thread.

    `case` and `scene` are what is registered, `order` says how, and `work` does it. `order.out` is the run.
    """

    def __init__(self, case: Case, scene: Scene, order: Order, work: Work) -> None:
        self.case, self.scene, self.run = case, scene, order.out
        self._order, self._work = order, work
        self._lock, self._drawing_lock, self._report_lock = Lock(), Lock(), Lock()
        self._edges = Edges(scene)
        self._reviewed = self._read()
        result = None if self._reviewed is None else self._reviewed.result
        self._placed = with_kept(self.run, case, scene, placed_at_first(case, scene, result))
        self._revision = 0
        self.pictures = pictures(scene, self._placed.poses)
        self.placed_objects = tuple(self._placed.poses.camera1_from)
        self._registration: Registration | None = None
        self._settled = True
        self._drawn: tuple[tuple[int, int], dict[str, Any]] | None = None
        self._report: tuple[str, str] | None = None

    def _read(self) -> Reviewed | None:
        """The result of the run, None where there is none. Raises `InputError` for one that does not fit the case."""
        if not (self.run / RESULT_NAME).exists():
            return None
        digest, result = result_sha256(self.run), read_result(self.run)
        read_review(self.run)  # a file that is none is complained of now
        check_fits(self.case, result)
        return Reviewed(result, digest)

    @property
    def reviewed(self) -> Reviewed | None:
        """The result that is looked at."""
        with self._lock:
            self._settle()
            return self._reviewed

    @property
    def changed(self) -> bool:
        """Whether another program has changed the result since it was read."""
        reviewed = self.reviewed
        there = (self.run / RESULT_NAME).exists()
        return there != (reviewed is not None) or (reviewed is not None and result_sha256(self.run) != reviewed.digest)

    def report(self) -> str:
        """The report of the result, drawn when it is first asked for. Raises `RefusedError` if there is none."""
        reviewed = self.reviewed
        if reviewed is None:
            raise RefusedError("Nothing is registered yet.")
        with self._report_lock:
            if self._report is None or self._report[0] != reviewed.digest:
                self._report = (reviewed.digest, evaluation_page(self.case, reviewed.result, self.scene))
            return self._report[1]

    def state(self) -> dict[str, Any]:
        """What a page asks for again and again: whether anything changed, and how far a registration is."""
        with self._lock:
            self._settle()
            return self._state()

    def _state(self) -> dict[str, Any]:
        review = read_review(self.run) if self.run.is_dir() else None
        found = None if self._registration is None else self._registration.progress
        progress = None
        if found is not None:
            progress = {"state": found.state, "step": found.step, "share": found.share, "words": found.words}
        return {
            "revision": self._revision,
            "shown": list(self._shown()[0]),
            "digest": "" if self._reviewed is None else self._reviewed.digest,
            "decided": "" if review is None else review.time,
            "progress": progress,
        }

    def _shown(self) -> tuple[tuple[int, int], Placed]:
        """What the images show, and a number for it: what is placed, or where the registration under way is."""
        found = None if self._registration is None else self._registration.progress
        if found is None or found.state != "running" or found.poses is None:
            return (self._revision, 0), self._placed
        every = frozenset(range(self.scene.views))
        return (self._revision, found.moment), replace(self._placed, poses=found.poses, views=every)

    def drawing(self) -> dict[str, Any]:
        """The state and all that is drawn over the images, see `drawing`."""
        with self._lock:
            self._settle()
            number, placed = self._shown()
            state = self._state()
        with self._drawing_lock:
            if self._drawn is None or self._drawn[0] != number:
                self._drawn = (number, drawing(self.case, self.scene, placed, self._edges))
            return {**state, "shown": list(number), "drawing": self._drawn[1]}

    def change(self, change: Change) -> None:
        """Change what is placed, and keep it beside the run. Raises `RefusedError`, and `InputError` for nonsense."""
        if sum(part is not None for part in (change.move, change.mark, change.unmark, change.do)) != 1:
            raise InputError("a change: one of move, mark, unmark and do was expected.")
        with self._lock:
            self._check(change.revision)
            placed = self._placed
            if change.move is not None:
                placed = moved(self.scene, placed, change.move)
            elif change.mark is not None:
                placed = marked(self.case, placed, change.mark)
            elif change.unmark is not None:
                placed = unmarked(placed, change.unmark)
            elif change.do == "find":
                placed = self._found(placed)
            elif change.do == "place":
                placed = by_landmarks(self.case, self.scene, placed)
            else:
                forget(self.run)
                placed = placed_at_first(
                    self.case, self.scene, None if self._reviewed is None else self._reviewed.result
                )
            if change.do != "reset":
                self._keep(placed)
            self._placed = placed
            self._revision += 1

    def _found(self, placed: Placed) -> Placed:
        """With the landmarks that the network sees in the first image in place of those that are there."""
        found = look_at(self.scene, 0, network_detector(self.case, self._order.weights))
        names = self.case.anatomy.landmark_names if self.case.anatomy is not None else ()
        seen = {
            name: (float(pixel[0]), float(pixel[1]))
            for name, pixel, visible in zip(names, found.pixels, found.visible.tolist(), strict=True)
            if visible and name in self.case.landmarks
        }
        if not seen:
            raise InputError("the network finds no landmark in the first image. Put them there by hand.")
        return replace(placed, landmarks=seen)

    def _keep(self, placed: Placed) -> None:
        if placed.landmarks != self._placed.landmarks:
            keep_landmarks(self.run, self.case, placed)
        if placed.poses is not self._placed.poses:
            keep_poses(self.run, placed)

    def start(self, source: Source, revision: int) -> None:
        """Start a registration from the landmarks or the objects as placed, or as `femoreg register` by itself."""
        with self._lock:
            self._check(revision)
            order = self._order
            if source == "landmarks":
                by_landmarks(self.case, self.scene, self._placed)  # or it would be refused a minute later
                keep_landmarks(self.run, self.case, self._placed)
                order = replace(order, landmarks=landmarks_path(self.run))
            elif source == "objects":
                keep_poses(self.run, self._placed)
                order = replace(order, start=start_path(self.run))
            self._registration, self._settled = Registration(self._work, order), False
            self._revision += 1

    def cancel(self) -> None:
        """End the registration under way. Raises `RefusedError` where there is none."""
        with self._lock:
            self._settle()
            if self._registration is None or self._settled:
                raise RefusedError("No registration is running.")
            self._registration.cancel()
            self._settle()

    def close(self) -> None:
        """End what is under way, with the review."""
        with self._lock:
            if self._registration is not None and not self._settled:
                self._registration.cancel()

    def _check(self, revision: int) -> None:
        """Raises `RefusedError` while a registration runs, and for a page that shows what is no more."""
        self._settle()
        if not self._settled:
            raise RefusedError(_BUSY)
        if revision != self._revision:
            raise RefusedError(_MEANWHILE)

    def _settle(self) -> None:
        """Take over what a registration that has ended wrote."""
        if self._registration is None or self._settled or self._registration.progress.state == "running":
            return
        self._settled = True
        self._revision += 1
        if self._registration.progress.state == "done":
            self._reviewed = self._read()
            forget(self.run)
            result = None if self._reviewed is None else self._reviewed.result
            self._placed = placed_at_first(self.case, self.scene, result)

    def decide(self, decision: Decision, note: str, reviewer: str, time: str, digest: str, before: str) -> None:
        """Write a decision. Raises `RefusedError` if the result or an earlier decision changed since the page was made.

        The page showed the result with this digest, and a decision of the time `before`, empty for none.
        """
        with self._lock:
            self._settle()
            if self._reviewed is None:
                raise RefusedError("Nothing was written: nothing is registered yet.")
            if not self._settled:
                raise RefusedError(f"Nothing was written. {_BUSY}")
            if result_sha256(self.run) != self._reviewed.digest:
                raise RefusedError("Nothing was written: the result has changed since. Start the review again.")
            if digest != self._reviewed.digest:
                raise RefusedError("Nothing was written: there is a new result, which is shown now. Look at it first.")
            earlier = read_review(self.run)
            if before != ("" if earlier is None else earlier.time):
                raise RefusedError("Nothing was written: somebody has decided meanwhile, see above. Decide again.")
            write_review(self.run, Review(decision, note, reviewer, time, self._reviewed.digest))
