"""A computation in a second process, a copy of this one, while this process computes something else.

    later = Forked(robustness, loop, coupling)  # The second process begins.
    ..                                          # This process computes at the same time.
    value = later.result()

The result does not depend on which process is faster. If there is no second process, or if it ends without a result,
this process computes the function, and raises its errors.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Generic, NoReturn, TypeVar

_Result = TypeVar("_Result")

#: Whether second processes are allowed. They are allowed in a command that has its process for itself and loads no code
#: of the user. Other code may print, write files, or have threads whose locks a copy of the process would inherit.
allowed = False

_PR_SET_PDEATHSIG = 1  # number of an operation of Linux's prctl


class Forked(Generic[_Result]):
    """A call of a function that neither prints nor writes files, in a second process if that is possible.

    With a `niceness` above 0 the second process gives way to the first one on a busy machine.
    """

    def __init__(self, function: Callable[..., _Result], *arguments: Any, niceness: int = 0) -> None:
        self._call, self._niceness = partial(function, *arguments), niceness
        self._process = 0  # number of the second process, or 0 if there is none
        if allowed and sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1:
            with suppress(OSError):  # There may be too many processes or open files.
                self._fork()

    def _fork(self) -> None:
        self._reader, writer = os.pipe()
        # The second process must not handle Ctrl-C or SIGTERM as a command does.
        handled = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            with warnings.catch_warnings():  # Python 3.12 warns of a fork while a thread runs, here of a progress bar.
                warnings.simplefilter("ignore", DeprecationWarning)
                self._process = os.fork()
            if not self._process:
                self._compute(writer)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, handled)
            os.close(writer)

    def _compute(self, writer: int) -> NoReturn:  # pragma: no cover - runs in the second process
        """Send the pickled result to `writer` and end, without output and without the first process's files."""
        global allowed
        code, allowed = 1, False
        try:
            import ctypes

            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # The second process ends with the first.
            os.nice(self._niceness)
            os.dup2(writer, 3)
            for opened in os.listdir("/proc/self/fd"):
                if int(opened) > 3:
                    with suppress(OSError):  # the descriptor of listdir, which is closed
                        os.close(int(opened))
            for stream in range(3):
                os.dup2(os.open(os.devnull, os.O_RDWR), stream)
            with open(3, "wb") as file:
                pickle.dump(self._call(), file, pickle.HIGHEST_PROTOCOL)
            code = 0
        finally:
            os._exit(code)

    def result(self) -> _Result:
        """Return the function's result; a second call computes it again in this process."""
        if self._process:
            with open(self._reader, "rb") as file:
                data: Any = file.read()
            process, self._process = self._process, 0
            if os.waitpid(process, 0)[1] == 0:
                return pickle.loads(data)
        return self._call()
