"""One thread that owns the contact: it always goes towards the newest wish, and refines the answer when there is nothing to go to."""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from twin.errors import TwinError
from twin.optics.preview import Shading
from twin.studio.contact import Answer, Light, MovingContact
from twin.studio.pose import ObjectPose
from twin.studio.tracing import Failed, Outcome, Saved, Traced, Tracer

LOG = logging.getLogger(__name__)
STILL_S = 0.04
"""The object stands still once no wish has come for this time, in s."""
REFINE_S = 1.0
"""Time in s without a wish after which the fine mesh follows. A step on it takes some 0.1 s, for which a new wish has to wait."""
LOOK_S = 0.02
"""Interval in s at which it is looked for what is due."""


def told(error: Exception) -> str:
    """An error in words for the page. A fault of this program is also logged with its traceback: the thread goes on."""
    if isinstance(error, TwinError):
        return str(error)
    LOG.error("a fault of this program", exc_info=error)
    return f"a fault of this program ({error!r}); what is shown may be an earlier state"


Wish = tuple[ObjectPose, float]
"""A pose, and the time (``time.monotonic``) at which it was wished."""


class _OwnThread(ABC):
    """Work in a thread of its own, which waits for news.

    Parameters
    ----------
    name : str
        Of the thread.
    """

    def __init__(self, name: str) -> None:
        self._news = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; waits for what is being done."""
        with self._news:
            self._ended = True
            self._news.notify()
        if self._thread.is_alive():
            self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """Work until it is ended."""


class Worker(_OwnThread):
    """Moves a contact in a thread of its own. A context manager.

    Parameters
    ----------
    contact : MovingContact
    tracer : Tracer or None
        None: pictures stay drawn.
    on_answer : callable
        Called with each answer, in the worker's thread.
    on_message : callable
        Called with a line for the user: what was saved, or what failed.
    """

    def __init__(
        self,
        contact: MovingContact,
        tracer: Tracer | None,
        on_answer: Callable[[Answer], None],
        on_message: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._contact, self._tracer = contact, tracer
        self._on_answer, self._on_message = on_answer, on_message
        super().__init__("studio-worker")
        self._wish: Wish | None = None
        self._jobs: deque[Callable[[], None]] = deque()
        self._way: deque[Wish] = deque()
        self._asked_trace = 0
        self._moved_s = time.monotonic()
        self._newest: Answer | None = None
        self._traces = tracer is not None
        if tracer is not None:
            tracer.on_outcome = self._wake

    def _wake(self) -> None:
        """Look for outcomes of the tracer at once."""
        with self._news:
            self._news.notify()

    @property
    def newest(self) -> Answer | None:
        """The newest answer."""
        return self._newest

    @property
    def playing(self) -> bool:
        """Whether a way is being played."""
        return bool(self._way)

    def ask(self, wished: ObjectPose) -> None:
        """Go to a pose from now on. Earlier wishes, and a way that is played, are forgotten."""
        with self._news:
            self._way.clear()
            self._wish = (wished, time.monotonic())
            self._news.notify()

    def play(self, way: list[tuple[float, ObjectPose]]) -> None:
        """Go through poses, each at its time in s from now or, where the contact takes longer, as soon as it can."""
        begin = time.monotonic()
        with self._news:
            self._way = deque((pose, begin + at) for at, pose in way)
            self._news.notify()

    def do(self, job: Callable[[], None]) -> None:
        """Call a function in the worker's thread, between two steps. Its error becomes a message."""
        with self._news:
            self._jobs.append(job)
            self._news.notify()

    def show_again(self) -> None:
        """Make the newest answer anew: after a change of form or model. Only for the worker's thread."""
        answer = self._contact.again()
        if answer is not None:
            self._publish(answer)

    def __enter__(self) -> "Worker":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        while True:
            with self._news:
                if not (self._jobs or self._due() or self._ended or self._busy()):
                    self._news.wait(LOOK_S)
                if self._ended:
                    return
                job = self._jobs.popleft() if self._jobs else None
                wish = self._due()
            try:
                self._turn(job, wish)
            except Exception as error:
                with self._news:
                    if self._wish is wish:
                        self._wish = None
                self._moved_s = time.monotonic()  # so that what fails on the fine mesh is not tried without a pause
                self._on_message(told(error))

    def _due(self) -> Wish | None:
        """The wish to go to now. A pose of a way that is played waits for its time, and for the one before."""
        if self._way and self._way[0][1] <= time.monotonic() and self._wish is None:
            self._wish = self._way.popleft()
        return self._wish

    def _busy(self) -> bool:
        """Whether the fine mesh has something to do."""
        newest = self._newest
        seen = newest is not None and (newest.lit is Light.TRACED or not self._traces)
        return seen and not self._way and time.monotonic() - self._moved_s > REFINE_S and not self._contact.refined

    def _turn(self, job: Callable[[], None] | None, wish: Wish | None) -> None:
        if job is not None:
            job()
        for outcome in self._tracer.outcomes() if self._tracer is not None else ():
            self._take(outcome)
        if wish is not None:
            self._publish(self._contact.step(wish[0]))
            self._moved_s = time.monotonic()
            with self._news:
                if self._newest is not None and self._newest.arrived and self._wish is wish:
                    self._wish = None
        elif self._busy():
            refined = self._contact.refine()
            if refined is not None and self._traces and self._tracer is not None:
                self._asked_trace = refined.solved
                self._tracer.trace(refined.solved, refined.state)  # it is shown with its own picture
            elif refined is not None:
                self._publish(refined)
        if wish is None:
            self._ask_trace()

    def _ask_trace(self) -> None:
        """Ask for the path-traced picture of an answer that stands still."""
        newest = self._newest
        if newest is None or not self._traces or self._tracer is None or self._way:
            return
        still = time.monotonic() - self._moved_s > STILL_S
        if still and newest.lit is Light.DRAWN and newest.solved != self._asked_trace:
            self._asked_trace = newest.solved
            self._tracer.trace(newest.solved, newest.state)

    def _take(self, outcome: Outcome) -> None:
        match outcome:
            case Traced():
                answer = None
                if not (outcome.rough and self._newest is not None and self._newest.lit is Light.TRACED):  # no good picture gives way
                    lit = Light.ROUGH if outcome.rough else Light.TRACED
                    answer = self._contact.traced(outcome.solved, outcome.light, lit, outcome.ms)
                if answer is not None:
                    self._publish(answer)
            case Shading():
                self._contact.camera.preview.shading = outcome
                self._moved_s = time.monotonic()
                self.show_again()
            case Saved():
                self._on_message(f"saved {outcome.written[0].parent} ({len(outcome.written)} files)")
            case Failed():
                if outcome.tracing:
                    self._traces = False
                self._on_message(outcome.reason)

    def _publish(self, answer: Answer) -> None:
        if self._newest is None and self._tracer is not None:
            self._tracer.start()  # only now, so that the first picture does not wait for it
        self._newest = answer
        self._on_answer(answer)


T = TypeVar("T")


class Newest(_OwnThread, Generic[T]):
    """Calls a function with the newest of the things it is given, in a thread of its own, one at a time.

    Parameters
    ----------
    take : callable
    name : str
        Of the thread.
    failed : callable, optional
        Called with the text of an error of ``take``. The thread goes on.
    """

    def __init__(self, take: Callable[[T], None], name: str, failed: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(name)
        self._take, self._failed = take, failed
        self._waiting: list[T] = []

    def give(self, thing: T) -> None:
        """Take this next; what has not been taken yet is forgotten."""
        with self._news:
            self._waiting = [thing]
            self._news.notify()

    @property
    def overtaken(self) -> bool:
        """Whether something newer waits. For a ``take`` that can stop early."""
        return bool(self._waiting) or self._ended

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._ended or self._waiting)
                if self._ended:
                    return
                thing = self._waiting.pop()
            try:
                self._take(thing)
            except Exception as error:
                self._failed(told(error))
