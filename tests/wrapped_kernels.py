"""Kernels that are interrupted on purpose."""

import gc
import signal
import threading
from contextlib import contextmanager

from symgraph.compile.kernel import BoundKernel


class Interrupting(BoundKernel):
    """As if the user pressed Ctrl-C before a method hands out its n-th start."""

    def __init__(self, inner, method, start):
        self.inner, self.method, self.left = inner, method, start

    def evaluate(self, *arguments):
        return self.inner.evaluate(*arguments)

    def climb(self, *arguments):
        return self._handed_out("climb", arguments)

    def ascend(self, *arguments):
        return self._handed_out("ascend", arguments)

    def _handed_out(self, method, arguments):
        for found in getattr(self.inner, method)(*arguments):
            self.left -= method == self.method
            if self.left == 0:
                raise KeyboardInterrupt
            yield found


class InterruptedLater(Interrupting):
    """The user does press Ctrl-C, some seconds after a method began."""

    def __init__(self, inner, method, seconds):
        super().__init__(inner, method, -1)
        self.seconds = seconds

    def _handed_out(self, method, arguments):
        if method != self.method:
            yield from getattr(self.inner, method)(*arguments)
            return
        with ctrl_c_after(self.seconds):
            yield from getattr(self.inner, method)(*arguments)


@contextmanager
def ctrl_c_after(seconds):
    """The signal that Ctrl-C sends, as the terminal sends it: to the main thread, wherever that is.

    Were that in one of the callbacks that Hypothesis lets the garbage collector call, Python would note the exception
    and drop it.
    """
    timer = threading.Timer(seconds, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT])
    callbacks, gc.callbacks[:] = gc.callbacks[:], []
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        gc.callbacks[:] = callbacks


def wrap_kernels(monkeypatch, kind, wrap):
    """All kernels of a kind are wrapped when they are bound."""
    original = kind.bind
    monkeypatch.setattr(kind, "bind", lambda self, *given: wrap(original(self, *given)))
