"""The thread that owns the contact. It always moves towards the newest wish, and refines the answer when no wish is open."""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from scenes.base import SpecError
from twin.errors import TwinError, format_count
from twin.optics.preview import Shading
from twin.studio.contact import ContactAnswer, Light, MovingContact
from twin.studio.pose import ObjectPose
from twin.studio.tracing import Failed, Outcome, Saved, Traced, Tracer

LOG = logging.getLogger(__name__)
STILL_S = 0.04
"""Time, s, without a wish after which the object counts as standing still."""
REFINE_S = 1.0
"""Time, s, without a wish after which the fine mesh follows. A step on it takes some 0.1 s, and a new wish must wait for it."""
LOOK_S = 0.02
"""Interval, s, at which due work is looked for."""


def describe_error(error: Exception) -> str:
    """An error as text for the page. A fault of this program is also logged with its traceback, and the thread continues."""
    if isinstance(error, TwinError | SpecError):
        return str(error)
    LOG.error("a fault of this program", exc_info=error)
    return f"a fault of this program ({error!r}); what is shown may be an earlier state"


Wish = tuple[ObjectPose, float]
"""A pose, and the time (``time.monotonic``) of the wish."""


class _OwnThread(ABC):
    """A thread that waits for work.

    Parameters
    ----------
    name : str
        Name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._news = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread after its present work."""
        with self._news:
            self._ended = True
            self._news.notify()
        if self._thread.is_alive():
            self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """Work until the thread is ended."""


class Worker(_OwnThread):
    """Moves a contact in its own thread.

    Parameters
    ----------
    contact : MovingContact
    tracer : Tracer or None
        If it is None, pictures stay rasterised.
    on_answer : callable
        Called with each answer, in the worker's thread.
    on_message : callable
        Called with a line for the user about saved files or failures.
    """

    def __init__(
        self, contact: MovingContact, tracer: Tracer | None, on_answer: Callable[[ContactAnswer], None], on_message: Callable[[str], None]
    ) -> None:
        self._contact, self._tracer = contact, tracer
        self._on_answer, self._on_message = on_answer, on_message
        super().__init__("studio-worker")
        self._wish: Wish | None = None
        self._jobs: deque[Callable[[], None]] = deque()
        self._way: deque[Wish] = deque()
        self._asked_trace = 0
        self._moved_s = time.monotonic()
        self.newest: ContactAnswer | None = None
        self._traces = tracer is not None
        if tracer is not None:
            tracer.on_outcome = self._wake

    def _wake(self) -> None:
        """Take the tracer's outcomes at once."""
        with self._news:
            self._news.notify()

    def ask(self, wished: ObjectPose) -> None:
        """Move to a pose from now on. Earlier wishes, and a path that is being played, are dropped."""
        with self._news:
            self._way.clear()
            self._wish = (wished, time.monotonic())
            self._news.notify()

    def play(self, way: list[tuple[float, ObjectPose]]) -> None:
        """Move through poses. Each has its time in s from now. If the contact takes longer, the next pose follows as soon as possible."""
        begin = time.monotonic()
        with self._news:
            self._way = deque((pose, begin + at) for at, pose in way)
            self._news.notify()

    def do(self, job: Callable[[], None]) -> None:
        """Call a function in the worker's thread, between two steps. An error of it becomes a message."""
        with self._news:
            self._jobs.append(job)
            self._news.notify()

    def show_again(self) -> None:
        """Compute the newest answer again after a change of form or model. Only the worker's thread may call this."""
        answer = self._contact.again()
        if answer is not None:
            self._publish(answer)

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
                self._moved_s = time.monotonic()  # so that a failed step on the fine mesh is not repeated without a pause
                self._on_message(describe_error(error))

    def _due(self) -> Wish | None:
        """The wish to move to now. A pose of a played path waits for its time, and for the pose before it."""
        if self._way and self._way[0][1] <= time.monotonic() and self._wish is None:
            self._wish = self._way.popleft()
        return self._wish

    def _busy(self) -> bool:
        """Whether the fine mesh has something to do."""
        newest = self.newest
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
                if self.newest is not None and self.newest.arrived and self._wish is wish:
                    self._wish = None
        elif self._busy():
            refined = self._contact.refine()
            if refined is not None and self._traces and self._tracer is not None:
                self._asked_trace = refined.solved
                self._tracer.trace(refined.solved, refined.state)  # the answer is shown together with its traced picture
            elif refined is not None:
                self._publish(refined)
        if wish is None:
            self._ask_trace()

    def _ask_trace(self) -> None:
        """Request the path-traced picture of an answer that stands still."""
        newest = self.newest
        if newest is None or not self._traces or self._tracer is None or self._way:
            return
        still = time.monotonic() - self._moved_s > STILL_S
        if still and newest.lit is Light.RASTERISED and newest.solved != self._asked_trace:
            self._asked_trace = newest.solved
            self._tracer.trace(newest.solved, newest.state)

    def _take(self, outcome: Outcome) -> None:
        match outcome:
            case Traced():
                if outcome.rough and self.newest is not None and self.newest.lit is Light.TRACED:
                    return  # no good picture gives way
                lit = Light.ROUGH if outcome.rough else Light.TRACED
                if (answer := self._contact.newest_traced(outcome.solved, outcome.light, lit, outcome.ms)) is not None:
                    self._publish(answer)
            case Shading():
                self._contact.camera.preview.shading = outcome
                self._moved_s = time.monotonic()
                self.show_again()
            case Saved():
                self._on_message(f"saved {outcome.written[0].parent} ({format_count(len(outcome.written), 'files')})")
            case Failed():
                if outcome.tracing:
                    self._traces = False
                self._on_message(outcome.reason)

    def _publish(self, answer: ContactAnswer) -> None:
        if self.newest is None and self._tracer is not None:
            self._tracer.start()  # not earlier, so that the first picture does not wait for it
        self.newest = answer
        self._on_answer(answer)


T = TypeVar("T")


class Newest(_OwnThread, Generic[T]):
    """Calls a function in its own thread with the newest item that was given. Calls do not overlap.

    Parameters
    ----------
    take : callable
    name : str
        Name of the thread.
    failed : callable, optional
        Called with the text of an error of ``take``. The thread continues.
    """

    def __init__(self, take: Callable[[T], None], name: str, failed: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(name)
        self._take, self._failed = take, failed
        self._waiting: list[T] = []

    def give(self, thing: T) -> None:
        """Use this item next. An item that still waits is dropped."""
        with self._news:
            self._waiting = [thing]
            self._news.notify()

    @property
    def overtaken(self) -> bool:
        """Whether a newer item waits. For a ``take`` that can stop early."""
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
                self._failed(describe_error(error))
