"""Progress of an engine on a terminal: its last message and the elapsed time, on one line.

Engines log; nobody else is asked to know about terminals. In a pipe nothing is shown, and with
``--verbose`` the messages go their usual way, as lines.
"""

import logging
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

TICK_S = 0.5
ENGINES = "toftools.sim"


@contextmanager
def progress(*, verbose: bool, engines: str = ENGINES) -> Iterator[None]:
    """Show what an engine says while the block runs, if a person can see it.

    Parameters
    ----------
    verbose : bool
        Messages are printed as lines already.
    engines : str
        Logger to listen to, with all below it.

    Yields
    ------
    None
        While the line is alive; it is wiped at the end, however that comes.
    """
    stream = sys.stderr
    if verbose or not stream.isatty():
        yield
        return
    line, log = _Line(stream), logging.getLogger(engines)
    handler, level, passes_on = _Handler(line), log.level, log.propagate
    stop = threading.Event()
    ticker = threading.Thread(target=_tick, args=(line, stop), daemon=True)
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    ticker.start()
    try:
        yield
    finally:
        stop.set()
        ticker.join()
        log.removeHandler(handler)
        log.setLevel(level)
        log.propagate = passes_on
        line.wipe()


class _Line:
    """One line of a terminal that is written over again and again."""

    def __init__(self, stream: TextIO) -> None:
        self.stream, self.began, self.text = stream, time.monotonic(), "starting"
        self.lock = threading.Lock()

    def draw(self) -> None:
        columns = shutil.get_terminal_size().columns
        text = f"{_clock(time.monotonic() - self.began)}  {self.text}"
        with self.lock:
            self.stream.write(f"\r\x1b[K{text[: columns - 1]}")
            self.stream.flush()

    def wipe(self, last: str = "") -> None:
        with self.lock:
            self.stream.write(f"\r\x1b[K{last}")
            self.stream.flush()


class _Handler(logging.Handler):
    """Messages become the text of the line; warnings stay, on lines of their own."""

    def __init__(self, line: _Line) -> None:
        super().__init__()
        self.line = line

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING:
            self.line.wipe(f"{record.levelname}: {record.getMessage()}\n")
        else:
            self.line.text = record.getMessage()
        self.line.draw()


def _tick(line: _Line, stop: threading.Event) -> None:
    while not stop.wait(TICK_S):
        line.draw()


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02d}"
