"""The progress bar: there when it takes long and somebody looks."""

import io
import sys
import threading
import time

import pytest
import rich.console

from symgraph import progress as module
from symgraph.progress import Progress

CONSOLE = rich.console.Console


class Terminal(io.StringIO):
    def isatty(self):
        return True


def show_on(screen, monkeypatch):
    """Let rich write here instead of to stderr, which pytest replaces between a fixture and its test."""

    def console(*, file):
        assert file is sys.stderr  # never among a program's output
        return CONSOLE(file=screen)

    monkeypatch.setattr(rich.console, "Console", console)


@pytest.fixture
def terminal(monkeypatch):
    screen = Terminal()
    show_on(screen, monkeypatch)
    monkeypatch.setenv("TERM", "xterm-256color")
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(module, "DELAY", 0.02)
    return screen


def wait_until(condition):
    end = time.monotonic() + 5
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()


def test_a_bar_appears_when_it_takes_long(terminal):
    with Progress("planning") as bar:
        bar.update(1, 10)
        assert terminal.getvalue() == ""
        time.sleep(0.03)
        bar.update(2, 10)
        bar.update(9, 10)
    assert "planning" in terminal.getvalue()


def test_no_bar_when_it_is_quick(terminal):
    with Progress("planning") as bar:
        for i in range(100):
            bar.update(i, 100)
    assert terminal.getvalue() == ""


def test_no_bar_when_it_is_not_wanted(terminal):
    with Progress("planning", shown=False) as bar:
        time.sleep(0.03)
        bar.update(1, 2)
        bar.wait("compiling")
        time.sleep(0.05)
    assert terminal.getvalue() == ""


def test_no_bar_where_nobody_looks(terminal, monkeypatch):
    screen = io.StringIO()
    show_on(screen, monkeypatch)
    with Progress("planning") as bar:
        time.sleep(0.03)
        bar.update(1, 2)
        bar.update(2, 2)
    assert screen.getvalue() == ""


def test_work_that_cannot_report_is_announced(terminal):
    with Progress("planning") as bar:
        bar.wait("compiling")
        wait_until(lambda: "compiling" in terminal.getvalue())


def test_what_comes_after_it_has_its_own_name(terminal):
    with Progress("planning") as bar:
        bar.wait("compiling")
        wait_until(lambda: "compiling" in terminal.getvalue())
        bar.begin("planning")
        bar.update(1, 2)
        wait_until(lambda: "planning" in terminal.getvalue())


def test_no_bar_when_the_wait_is_short(terminal):
    with Progress("planning") as bar:
        bar.wait("compiling")
    time.sleep(0.05)
    assert terminal.getvalue() == ""


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_the_bar_goes_with_the_work(terminal, error):
    before = threading.active_count()

    def interrupted():
        with Progress("planning") as bar:
            time.sleep(0.03)
            bar.update(1, 2)
            raise error

    with pytest.raises(error):
        interrupted()
    wait_until(lambda: threading.active_count() <= before)
    assert "\x1b[?25h" in terminal.getvalue()  # the cursor is back


def test_updates_are_cheap():
    with Progress("planning") as bar:
        begin = time.perf_counter()
        for i in range(10_000):
            bar.update(i, 10_000)
        assert time.perf_counter() - begin < 0.5
