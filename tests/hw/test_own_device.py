"""A class of the user's own drives a device for hw.bridge and hw.identify, here in virtual time."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from forked import run

from haptic_loop.cli import bridge, identify
from haptic_loop.design.own import named
from haptic_loop.hw import transport
from haptic_loop.hw.protocol import Command, Config, Force, Phase, Reason, Refused
from haptic_loop.sim.scenario import InputError, load

PAGE = Path(__file__).parents[2] / "docs/extending.md"
OPTIONS = ["--arm", "--no-dead-man", "--no-axis-check", "--no-preflight", "--measure", "100"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Return the path of the page's example, with a deaf device and mistakes."""
    (code,) = re.findall(r"```python\n(# emulated.py.*?)```", PAGE.read_text(), flags=re.DOTALL)
    path = tmp_path_factory.mktemp("own") / "emulated.py"
    path.write_text(code + MORE)
    return path


MORE = """
opened = []


class Opened(Emulated):
    def __enter__(self):
        opened.append(True)
        return self

    def __exit__(self, *_):
        opened.append(False)


class Unplugged(Emulated):
    def exchange(self, force):
        raise OSError("usb gone")


class Number(Emulated):
    def exchange(self, force):
        return 3


class Absent(Emulated):
    def __init__(self, scenario):
        raise OSError("no device at usb 3")


class Deaf:
    errors, exchange, stop = 0, None, None

    def __init__(self, scenario):
        pass


number = 3
"""


@pytest.fixture
def module(file, monkeypatch):
    """Return the file's module. Its clock and the session's are virtual: a look at the clock takes 1 us."""
    now = [0.0]

    def monotonic():
        now[0] += 1e-6
        return now[0]

    def sleep(seconds):
        now[0] += seconds

    clock = SimpleNamespace(monotonic=monotonic, sleep=sleep, monotonic_ns=lambda: round(1e9 * monotonic()))
    own = named("--port", f"{file}:Emulated")
    module = __import__(own.__module__)
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(transport, "time", clock)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(("latch", "delays", "late"), [("tick", [1, 2], 0), ("arrival", [1, 2], 1)])
def test_a_session_drives_the_users_own_device(file, module, tmp_path, latch, delays, late):
    port = ["--port", f"{file}:Opened", *OPTIONS, "--latch", latch, "--duration", "0.5", "--no-plot"]
    assert bridge.main([*port, "--out", str(tmp_path), "--json", str(tmp_path / "r.json")]) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["session"]["stage"] == "finished"
    assert report["assessment"]["loop"]["theta"] == delays
    assert bool(report["assessment"]["loop"]["latency_s"]) == late
    assert module.opened == [True, False]
    module.opened.clear()


@pytest.mark.slow
def test_the_users_own_device_is_identified(file, module, tmp_path):
    options = ["--arm", "--no-dead-man", "--no-axis-check", "--sittings", "1", "--json", str(tmp_path / "r.json")]
    assert identify.main(["--port", f"{file}:Emulated", *options, "--out", str(tmp_path)]) == 1  # one sitting: no bound
    axes = json.loads((tmp_path / "r.json").read_text())["axes"]
    assert [axis["friction"]["viscous"] for axis in axes] == pytest.approx([1.37, 1.37], rel=1e-3)


def test_the_page_waits_for_a_ramp(module):
    device = module.Emulated(load())
    config = Config(1, 4, 5, 0, (5000, 5000), (5000, 5000))
    assert device.configure(config) == Refused.ACCEPTED
    state = device.exchange(None)
    for _ in range(3):
        state = device.exchange(Force(Command.ARM, state.tick + 1, state.tick, (0, 0)))
    assert state.phase == Phase.ARMED
    device.stop(Reason.DONE)
    assert [device.configure(config) for _ in range(6)] == [None] * 5 + [Refused.ACCEPTED]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Missing", "has no Missing; it defines .*Emulated"),
        ("number", "is 3, expected a class or function that takes a scenario"),
        ("Decoder", "TypeError: .*argument"),
        ("Deaf", "without info, configure: see hw/haptic_device.py"),
    ],
)
def test_mistakes_in_own_devices_are_one_line(file, module, name, said):
    for command in (bridge, identify):
        options = OPTIONS if command is bridge else ["--arm", "--no-dead-man"]
        with pytest.raises(InputError, match=rf"--port .*emulated\.py:{name}.* {said}") as refused:
            command.main(["--port", f"{file}:{name}", *options])
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "stage", "cause"),
    [
        ("Unplugged", "lost", "OSError: usb gone"),
        ("Number", "stopped", "exchange() of the device returned 3, expected State or None"),
    ],
)
def test_errors_of_own_devices_end_the_session(file, module, tmp_path, name, stage, cause):
    report = tmp_path / "r.json"
    assert bridge.main(["--port", f"{file}:{name}", *OPTIONS, "--out", str(tmp_path), "--json", str(report)]) == 1
    session = json.loads(report.read_text())["session"]
    assert (session["stage"], session["cause"]) == (stage, cause)


def test_an_own_device_that_is_missing_names_its_line(file, tmp_path):
    done = run(f"python -m hw.bridge --port {file}:Absent --arm --no-dead-man --no-axis-check", tmp_path)
    assert done.returncode == 2
    assert re.fullmatch(
        r"error: .*emulated\.py, line \d+, which is your own code: OSError: no device at usb 3", done.stderr.strip()
    )


@pytest.mark.parametrize("port", ["missing.py:Device", "emulated.py", "emulated.py:A,emulated.py:B"])
def test_ports_of_own_devices_name_file_and_class(port):
    with pytest.raises(InputError, match=r"expected FILE\.py:NAME|there is no file"):
        bridge.main(["--port", port, *OPTIONS])


def test_own_devices_have_no_uart():
    with pytest.raises(InputError, match="--baud"):
        bridge.main(["--port", "emulated.py:Emulated", *OPTIONS, "--baud", "9600"])
