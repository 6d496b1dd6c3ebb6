"""Kernels that fail on purpose; in a module of their own so that worker processes can import them."""

import os
import signal
from pathlib import Path

from symgraph.compile.kernel import BoundKernel


class Wrapped(BoundKernel):
    """Does what the kernel inside does; others do something first."""

    def __init__(self, inner):
        self.inner = inner

    def before(self, method):
        """Called before each method with its name."""

    def evaluate(self, *arguments):
        self.before("evaluate")
        return self.inner.evaluate(*arguments)

    def climb(self, *arguments):
        self.before("climb")
        return self.inner.climb(*arguments)

    def ascend(self, *arguments):
        self.before("ascend")
        return self.inner.ascend(*arguments)


class Interrupting(Wrapped):
    """As if the user pressed Ctrl-C in the n-th call of a method."""

    def __init__(self, inner, method, call):
        super().__init__(inner)
        self.method, self.calls = method, call

    def before(self, method):
        if method == self.method:
            self.calls -= 1
            if self.calls == 0:
                raise KeyboardInterrupt


class Deadly(Wrapped):
    """Kills the worker process that moves a point: each one, or only the first."""

    def __init__(self, inner, home, mark=None):
        super().__init__(inner)
        self.home, self.mark = home, mark

    def before(self, method):
        if os.getpid() == self.home or method != "ascend":
            return
        if self.mark is not None:
            try:
                Path(self.mark).touch(exist_ok=False)
            except FileExistsError:
                return
        os.kill(os.getpid(), signal.SIGKILL)
