"""Learner of a live system: it watches the camera, and writes what it learns into the served model.

Two threads share its work: one takes the pictures and says what is thought, the other fits joints, tests
those of the model, and edits it. So a fit, or a server that is away, delays neither.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping

from kineverse.errors import ConflictError, KineverseError, OfflineError
from kineverse.exchange import LiveModel
from kineverse.lie import Array

from .model_estimator import ModelEstimator, Proposal
from .streams import CAMERA, LEARNER, CameraNote, LearnerNote, answer_by, decode, encode

_KEPT = 600  # pictures that wait while a joint is fitted
_THINKING = 0.1  # time between pictures after which joints are fitted, if they are due [s]
_NEWS = 0.2  # time between two notes [s]
_BLIND = 2.0  # time without a picture that is told of [s]
_OFFLINE = 1.0  # time between two tries while the server is away [s]


class LearnerProcess:
    """Model estimator that edits a served model.

    Parameters
    ----------
    live
        The served model.
    parts
        Frames, or patterns, of the parts whose joints are unknown, as for :class:`.ModelEstimator`.
    asks
        Whether operations that the model has are replaced only after somebody has accepted that.

    See Also
    --------
    kineverse.live.ModelEstimator
    """

    def __init__(self, live: LiveModel, parts: Iterable[str] = (), *, asks: bool = False) -> None:
        self._live = live
        self.estimator = ModelEstimator(live, parts, asks=asks)
        self._reader = live.exchange.reader()
        self._publisher = live.exchange.publisher(LEARNER, (), answer=answer_by({"accept": self._accept}))
        self._pictures: deque[tuple[float, Mapping[str, Array]]] = deque(maxlen=_KEPT)
        self._wishes: deque[str] = deque()
        self._news = threading.Event()
        self._note = LearnerNote()
        self._picture, self._arrival, self._known = -1.0, time.monotonic(), False
        self._waits, self._try_again = "", 0.0
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="kineverse-learn", daemon=True)
        self._thread.start()

    def run(
        self,
        is_over: Callable[[], bool] = lambda: False,
        *,
        on_edit: Callable[[str], object] = lambda _: None,
    ) -> None:
        """Learn until it is over; each edit, and why there was none, is told to a function."""
        told, last = 0.0, ""
        while not is_over():
            self._reader.wait(_NEWS)
            self.take()
            if (now := time.monotonic()) - told >= _NEWS:
                told = now
                self.tell()
                if self._note.last != last:
                    on_edit(last := self._note.last)

    def take(self) -> bool:
        """Take the newest picture, and return whether there was one."""
        newest = self._reader.newest(CAMERA)
        if newest is None or newest.stamp == self._picture:
            return False
        self._picture, self._arrival = newest.stamp, newest.arrival
        shown = decode(newest.note, CameraNote)
        self._known = shown is not None
        if shown is None:
            return False
        self._pictures.append((newest.stamp, shown.read()))
        self._news.set()
        return True

    def tell(self) -> None:
        """Publish what is thought."""
        note = self._note
        if problem := self._find_problem():
            note = LearnerNote(
                note.watched, note.alarms, note.proposals, note.edits, note.last, problem
            )  # fmt: skip
        self._publisher.put((), time.time(), encode(note))

    def _find_problem(self) -> str:
        if self._picture < 0.0:
            return "There is no camera: no picture has come in."
        if not self._known:
            return "The camera speaks another language; is its process of another version?"
        silent = time.monotonic() - self._arrival
        if silent > _BLIND:
            return f"No picture has come in for {silent:.0f} s."
        if self.estimator.blind > _BLIND:
            return "The camera sees nothing that the model has."
        return ""

    def _accept(self, tag: str) -> None:
        if tag not in (row.tag for row in self._note.proposals):
            raise KineverseError(f"Nothing is proposed for '{tag}' any more.")
        self._wishes.append(tag)
        self._news.set()

    # -- the other thread ------------------------------------------------------------------------------------

    def _work(self) -> None:
        thought = 0.0
        while not self._is_closed:
            self._news.wait(_NEWS)
            self._news.clear()
            while self._pictures and not self._is_closed:
                stamp, poses = self._pictures.popleft()
                self.estimator.add(poses, stamp)
                if abs(stamp - thought) >= _THINKING:  # also where many pictures have waited
                    thought = stamp
                    self._think()
            self._think()

    def _think(self) -> None:
        """Fit and test joints, edit the model, and say what is thought."""
        while self._wishes:
            if (tag := self._wishes.popleft()) in self.estimator.proposals:
                self.estimator.accept(tag)
        self.estimator.think()
        if time.monotonic() >= self._try_again:
            self._waits = ""
            for proposal in self.estimator.find_due():
                self._write(proposal)
        self._note = self.estimator.note(waits=self._waits)

    def _write(self, proposal: Proposal) -> None:
        live, estimator = self._live, self.estimator
        try:
            is_written = live.transact(lambda edit: proposal.write(edit, live), strict=True)
        except (OfflineError, ConflictError) as error:
            offline = isinstance(error, OfflineError)
            self._waits = "the model server is away" if offline else "others edit the model"
            self._try_again = time.monotonic() + _OFFLINE
            return
        except KineverseError as error:
            estimator.refuse(proposal, str(error))
            return
        if is_written:
            estimator.confirm(proposal)
        else:
            estimator.refuse(proposal, "somebody else has changed that")

    def close(self) -> None:
        """End the stream, and the work."""
        self._is_closed = True
        self._news.set()
        self._thread.join(_BLIND)
        self._publisher.close()
        self._reader.close()
