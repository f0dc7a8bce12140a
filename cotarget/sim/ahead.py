"""Frames rendered before they are asked for, on a thread with an OpenGL of its own.

The world up to now is settled: commands act from now on. As frames arrive late, the frame after the newest one is
often already exposed when that one is read, and can be rendered while the reader is at work. What is rendered does
not depend on it.
"""

import os
import queue
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future

from cotarget.rig import Image
from cotarget.sim.views import Views

Job = Callable[[Views], Image]
Jobs = queue.SimpleQueue[tuple[Job, "Future[Image]"] | None]

# So many frames must have been read one after the other, none left out, before the next one is expected to be: opening
# another OpenGL takes as long as it saves in some 20 frames.
READ_IN_TURN = 10
# An environment variable; "0" where every core has work of its own, such as one of many runs side by side.
ALLOWED = "COTARGET_AHEAD"


def is_allowed() -> bool:
    """Whether frames may be rendered on another thread at all."""
    return os.environ.get(ALLOWED) != "0"


class Ahead:
    """Renders the next frame of a camera whose frames are read one after the other.

    Args:
        open_views: opens the renderer; called on the thread that will use and close it.
    """

    def __init__(self, open_views: Callable[[], Views]) -> None:
        self._open_views = open_views
        self._jobs: Jobs = queue.SimpleQueue()
        self._finish: Callable[[], object] | None = None
        self._last, self._in_turn = -1, 0
        self._begun: tuple[int, Future[Image]] | None = None

    def take(self, index: int) -> Image | None:
        """Frame number ``index``, waited for if it was begun; None if it was not."""
        self._in_turn = self._in_turn + 1 if index == self._last + 1 else 0
        begun, self._begun, self._last = self._begun, None, index
        return begun[1].result() if begun is not None and begun[0] == index else None

    def begin(self, index: int, job: Job) -> None:
        """Begin to render frame number ``index``, if it is expected to be read next.

        Raises:
            DeviceError: the machine cannot render.
        """
        if self._in_turn < READ_IN_TURN or index != self._last + 1:
            return
        if self._finish is None:
            self._start()
        future: Future[Image] = Future()
        self._begun = index, future
        self._jobs.put((job, future))

    def close(self) -> None:
        """Release OpenGL, once what was begun is ready; more than once does no harm."""
        if self._finish is not None:
            self._finish()
        self._finish, self._in_turn, self._begun = None, 0, None

    def _start(self) -> None:
        """Open the renderer; waited for, because nothing may be rendered while another OpenGL is being opened."""
        opened: Future[None] = Future()
        work = (self._jobs, self._open_views, opened)
        thread = threading.Thread(target=_render, args=work, name="render ahead", daemon=True)
        thread.start()
        opened.result()
        # Also if nobody closes it, and at the interpreter's end.
        self._finish = weakref.finalize(self, _end, self._jobs, thread)


def _render(jobs: Jobs, open_views: Callable[[], Views], opened: "Future[None]") -> None:
    """Open a renderer, do jobs with it until there is None, and close it."""
    try:
        views = open_views()
    except Exception as error:
        opened.set_exception(error)
        return
    opened.set_result(None)
    del opened
    while (work := jobs.get()) is not None:
        _do(views, *work)
        del work  # it knows the world, which shall not live on while there is nothing to do
    views.close()


def _do(views: Views, job: Job, future: "Future[Image]") -> None:
    try:
        future.set_result(job(views))
    except Exception as error:
        future.set_exception(error)


def _end(jobs: Jobs, thread: threading.Thread) -> None:
    jobs.put(None)
    if thread is not threading.current_thread():
        thread.join()
