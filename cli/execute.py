"""Run a command: errors of its input become one line on standard error, and its exit code says what happened."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

from threadpoolctl import threadpool_limits

from haptic_loop.cli.options import BAD_INPUT, DOES_NOT_HOLD, INTERRUPTED, UNFINISHED
from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.units import in_unit
from haptic_loop.design.files import discard_output, lost_output, one_command, one_line
from haptic_loop.design.own import is_refusal, place_of
from haptic_loop.design.result import DesignFailed
from haptic_loop.sim.scenario import InputError


def execute(main: Callable[[list[str]], int], argv: list[str] | None = None, alone: bool = False) -> NoReturn:
    """Run a command and exit with its exit code. For bad input, print one line on standard error.

    The reader of standard output may stop at any line (`| head -1`) without changing the exit code. Temporary files are
    removed if SIGTERM or Ctrl-C ends the command. If the command is `alone` in its process, Ctrl-C interrupts it, and a
    further Ctrl-C ends the process.
    """
    code: str | int | None
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # for SciPy's BLAS, which is loaded later, and for child processes
    os.environ["MPLBACKEND"] = "Agg"  # Pictures are files; an unknown backend would stop the import of matplotlib.
    _streams()
    sys.unraisablehook = _repeat_interrupt
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminated)
    try:
        if alone:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        # The matrices are small: more BLAS threads only wait for each other and change the last digits.
        with threadpool_limits(1, user_api="blas"), one_command():
            code = _run(main, sys.argv[1:] if argv is None else argv)
    except (InputError, SingularLoop) as error:
        code = _say(f"error: {error}", BAD_INPUT)
    except DesignFailed as error:
        code = _say(f"not possible: {error}", DOES_NOT_HOLD)
    except KeyboardInterrupt:
        code = _say("interrupted", INTERRUPTED)
    except SystemExit as end:  # raised by --help and by SIGTERM
        code = end.code
    except MemoryError:
        code = _say("error: there is not enough memory for this", UNFINISHED)
    except OSError as error:  # mostly a full disk
        place = None if error.filename else place_of(error)
        own = f"error: {place}, which is your own code: {type(error).__name__}: {error}"
        code = _say(own, BAD_INPUT) if place else _cannot(error)
    except Exception as error:  # Python's exit code 1 would mean that a claim does not hold.
        place, code = place_of(error), UNFINISHED  # `place` is None for a mistake in this package
        if place and is_refusal(error):
            code = _say(f"error: {place}: {error}", BAD_INPUT)
        else:
            traceback.print_exc()
            if place:
                code = _say(f"error: {place}, which is your own code: {type(error).__name__}: {error}", BAD_INPUT)
    if alone:  # A further Ctrl-C leaves at once.
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        discard_output()
    except OSError as error:
        code = _cannot(error)
    if lost_output:
        code = _cannot(lost_output[0])
    # If Ctrl-C interrupted an exec() (dataclass() calls it), Python would end by SIGINT; a later exec() prevents this.
    exec("")
    sys.exit(code)


def _run(main: Callable[[list[str]], int], argv: list[str]) -> int:
    """Run the command. An error caused by a KeyboardInterrupt, as in a compiled module's import, counts as Ctrl-C."""
    try:
        return main(argv)
    except Exception as error:
        cause: BaseException | None = error
        while cause := cause.__cause__:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
        raise


def _say(message: str, code: int) -> int:
    print(in_unit(one_line(message)), file=sys.stderr)
    return code


def _cannot(error: OSError) -> int:
    discard_output()
    return _say(f"error: {error.filename or 'standard output'}: {error.strerror or error}", BAD_INPUT)


def _streams() -> None:
    """Replace closed standard streams, and escape characters that a terminal cannot show."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 - for as long as the command runs
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _terminated(number: int, frame: Any) -> NoReturn:
    raise SystemExit(_say("terminated", 128 + number))


_MOMENT = 0.05  # [s] time after which an ignored Ctrl-C is repeated


def _repeat_interrupt(unraisable: Any, shown: Callable[[Any], object] = sys.__unraisablehook__) -> None:
    """Repeat a Ctrl-C after a moment if it came during a clean-up such as __del__, in which Python ignores it.

    `shown` is an argument because Python deletes `sys` at its end.
    """
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        shown(unraisable)
        return
    # Unlike _thread.interrupt_main, a signal also ends a call in which the main thread waits.
    timer = threading.Timer(_MOMENT, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
    timer.daemon = True
    timer.start()
