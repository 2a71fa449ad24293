"""A picture that a second process draws, because loading matplotlib takes longer than loading NumPy and MuJoCo.

    painter = Painter()                      # The second process begins to load matplotlib.
    ..                                       # This process computes at the same time.
    painter.ask("draw_run", signals, title)  # The second process begins to draw plots.draw_run(signals, title).
    ..
    painter.save(path)                       # writes the picture

The second process sends the picture back and writes no file. It ends when the first process ends, because its standard
input is then closed. If it cannot start, or ends without a picture, the first process draws.
"""

from __future__ import annotations

import atexit
import os
import sys
from contextlib import suppress
from threading import Thread

TYPE_CHECKING = False
if TYPE_CHECKING:
    import subprocess
    from pathlib import Path
    from typing import Any

_begun: subprocess.Popen[bytes] | None = None  # the second process of the next Painter


def begin() -> None:
    """Start the second process of the next Painter."""
    global _begun
    _begun = _started()
    atexit.register(_end_begun)


def _end_begun() -> None:
    """End the second process if the command ended without a Painter."""
    if _begun:
        _end(_begun)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.communicate()


def _started() -> subprocess.Popen[bytes] | None:
    """Start a second process, unless this process has already loaded matplotlib."""
    if "matplotlib" in sys.modules or not sys.executable:
        return None
    import subprocess

    command = [sys.executable, "-P", "-c", f"from {__name__} import _serve; _serve()"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    pipe, none = subprocess.PIPE, subprocess.DEVNULL
    try:  # In a new session, Ctrl-C does not end the process: an interrupted run still draws its picture.
        return subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=none, start_new_session=True)
    except OSError:
        return None


class Painter:
    """Draws one picture in the second process of `begin`, or in a new one if `wanted`; else in this process."""

    def __init__(self, wanted: bool = True) -> None:
        global _begun
        self._process, _begun = _begun or (_started() if wanted else None), None
        self._asked: tuple[str, tuple[Any, ...]] | None = None

    def __del__(self) -> None:
        if self._process and self._process.returncode is None:
            _end(self._process)

    def ask(self, function: str, *arguments: Any) -> None:
        """Let the second process draw the figure that a function of sim.plots returns for these arguments."""
        self._asked = function, arguments
        if self._process and self._process.stdin:
            import pickle

            from haptic_loop.controller.units import current_unit

            request = pickle.dumps((current_unit(), function, arguments), pickle.HIGHEST_PROTOCOL)
            stdin, self._process.stdin = self._process.stdin, None  # communicate() must not use the closed pipe
            with suppress(BrokenPipeError), stdin:
                stdin.write(request)

    def save(self, path: Path) -> Path:
        """Write the figure of `ask` as a PNG file. Raises InputError if the file cannot be written."""
        assert self._asked
        if self._process:
            from haptic_loop.design.files import write

            png, _ = self._process.communicate()
            if self._process.returncode == 0:
                return write(path, png)
        skip_docstrings()
        from haptic_loop.sim import plots

        function, arguments = self._asked
        return plots.save(getattr(plots, function)(*arguments), path)


def _serve() -> None:
    """Be the second process: read the request of `ask` from standard input, write its picture to standard output.

    A thread reads while matplotlib is loaded, so that `ask` does not wait.
    """
    import pickle

    request = bytearray()

    def read() -> None:
        request.extend(sys.stdin.buffer.read())
        if not request:  # The first process has ended.
            os._exit(1)

    reader = Thread(target=read)
    reader.start()
    os.environ["MPLBACKEND"] = "Agg"
    skip_docstrings()
    from haptic_loop.controller.units import set_unit
    from haptic_loop.sim import plots

    reader.join()
    unit, function, arguments = pickle.loads(request)
    set_unit(unit)
    sys.stdout.buffer.write(plots.png(getattr(plots, function)(*arguments)))
    sys.stdout.flush()
    os._exit(0)  # Skip Python's clean-up, for which the first process would wait.


def skip_docstrings() -> None:
    """Make matplotlib load in half the time, by not composing docstrings and signatures of its classes."""
    from matplotlib import artist

    artist.kwdoc = lambda artist: ""
    vars(artist.Artist.set).pop("_autogenerated_signature", None)
