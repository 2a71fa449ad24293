"""hw.force_dimension works through the package forcedimension-core; a C stub replaces the maker's shared library."""

import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = importlib.util.find_spec("forcedimension_core")
pytestmark = [
    pytest.mark.skipif(PACKAGE is None, reason="forcedimension-core is not installed"),
    pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed: the C stub is not compiled here"),
]

SESSION = """
import ctypes, json, sys
from haptic_loop.hw.force_dimension import ForceDimension, library
from haptic_loop.hw.protocol import Command, Config, Force, Reason, SafetyStop
from haptic_loop.sim.scenario import load
stub, sdk, now = ctypes.CDLL(sys.argv[1]), library(), [0.0]
stub.stub_force.restype = stub.stub_limit.restype = ctypes.c_double

def clock():
    now[0] += 1e-6
    return now[0]

def sleep(seconds):
    now[0] += max(seconds, 0.0)

said = {}
with ForceDimension(load(), "sn4712x,0y", sdk, clock, sleep) as device:
    info = device.info()
    said |= {"serial": info.serial, "name": info.firmware, "guarded": device.guarded, "unused": device.unused_axes}
    said["refused"] = device.configure(Config(0, 4, 5, 0, (5000, 2500), (5000, 5000)))
    state, command = device.exchange(None), Command.ARM
    for k in range(6):
        force = (0, 0) if k < 2 else (1000, -500)
        state = device.exchange(Force(Command.ARM if k < 2 else Command.RUN, state.tick, state.tick, force))
    said["forces"] = [stub.stub_force(1, 0), stub.stub_force(0, 1)]
    said["limits"] = [stub.stub_limit(1), stub.stub_limit(0)]
    device.stop(Reason.DONE)
    ramped = [device.configure(Config(0, 4, 5, 0, (5000, 2500), (5000, 5000))) for _ in range(6)]
    said["ramped"] = [ramped, stub.stub_force(1, 0)]
    said["watchdogs"] = [stub.stub_watchdog(0), stub.stub_watchdog(1)]
for index, value in ((3, 1), (9, 7), (0, 0), (1, 0), (5, 0), (5, 99)):
    with ForceDimension(load(), "sn4712x,0y", sdk, clock, sleep) as device:
        device.configure(Config(0, 4, 5, 0, (5000, 2500), (5000, 5000)))
        state = device.exchange(None)
        for command, force in ((Command.ARM, (0, 0)), (Command.RUN, (1000, -500))):
            state = device.exchange(Force(command, state.tick, state.tick, force))
        pushed = [stub.stub_force(1, 0), stub.stub_force(0, 1)]
        stub.stub_status(1, index, value % 99)  # 5: forces are off; `value` is the cause, and 99 has no name
        stub.stub_status(1, 14, value if index == 5 else 0)
        try:
            device.exchange(Force(Command.RUN, state.tick, state.tick, (1000, -500)))
            trouble = None
        except SafetyStop as fault:
            trouble = str(fault)
        at_once = [stub.stub_force(1, 0), stub.stub_force(0, 1)]
        stub.stub_status(1, index, int(index in (0, 1, 5)))
        device.exchange(Force(Command.RUN, state.tick, state.tick, (1000, -500)))
        said[f"{index}={value}"] = [trouble, pushed, at_once, [stub.stub_force(1, 0), stub.stub_force(0, 1)]]
said["after"] = [stub.stub_force(1, 0), stub.stub_force(0, 1)]
with ForceDimension(load(), "sn4711x,sn4712x", sdk, clock, sleep) as device:
    device.configure(Config(0, 4, 5, 0, (5000, 2500), (5000, 5000)))
    state = device.exchange(None)
    for command, force in ((Command.ARM, (0, 0)), (Command.RUN, (1000, -500))):
        state = device.exchange(Force(command, state.tick, state.tick, force))
    said["pair"] = [stub.stub_force(0, 0), stub.stub_force(1, 0)]
six = ",".join(f"sn{serial}{axis}" for serial in (4711, 4712) for axis in "xyz")
with ForceDimension(load("omega-space"), six, sdk, clock, sleep) as device:
    said["held"] = device.unused_axes
    device.configure(Config(0, 4, 5, 0, (5000,) * 3 + (2500,) * 3, (5000,) * 6))
    said["vectors"] = [stub.stub_limit(0), stub.stub_limit(1)]
    state = device.exchange(None)
    for command, force in ((Command.ARM, (0,) * 6), (Command.RUN, (1000, -500, 250, 100, 200, -300))):
        state = device.exchange(Force(command, state.tick, state.tick, force))
    said["space"] = [stub.stub_force(index, axis) for index in (0, 1) for axis in range(3)]
with ForceDimension(load(), "sn4711x,sn4712x", sdk, clock, sleep, deadman=True) as device:
    device.configure(Config(0, 4, 5, 0, (5000, 2500), (5000, 5000)))
    said["buttons"] = []
    for ID in (0, 1):
        said["buttons"].append(device.exchange(None).deadman)
        stub.stub_button(ID, 1)
    said["buttons"].append(device.exchange(None).deadman)
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Return the results of sessions through the real binding."""
    folder = tmp_path_factory.mktemp("sdk") / "lib" / "release" / f"lin-{platform.machine()}-gcc"
    folder.mkdir(parents=True)
    sources = [path.read_text() for path in Path(PACKAGE.origin).parent.rglob("*.py")]
    names = {name for text in sources for name in re.findall(r"_lib\w+\.((?:dhd|drd)\w+)", text)}
    stub = (ROOT / "tests/firmware/dhd_stub.c").read_text()
    others = sorted(name for name in names if not re.search(rf"\b{name}\(", stub))
    (folder / "others.c").write_text("".join(f"int {name}(void) {{ return -1; }}\n" for name in others))
    library = folder / "libdrd.so.3"
    built = ["gcc", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-o", str(library)]
    subprocess.run([*built, str(ROOT / "tests/firmware/dhd_stub.c"), str(folder / "others.c")], check=True)
    environment = os.environ | {"FDSDK": str(folder.parents[2])}
    command = [sys.executable, "-c", SESSION, str(library)]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_a_device_is_opened_by_serial_number(session):
    assert (session["serial"], session["name"]) == (4712, "omega.3")


def test_two_devices_are_told_apart_by_serial_number(session):
    assert session["pair"] == pytest.approx([0.4, -0.2])


def test_axes_without_channel_are_named(session):
    assert session["unused"] == ["y and z of device sn4712", "x and z of device 0"]


def test_the_watchdog_is_set_in_expert_mode(session):
    assert session["guarded"]
    assert session["watchdogs"] == [160, 160]  # 160 x 125 us is 20 ms


def test_forces_reach_the_axes_they_are_for(session):
    assert session["refused"] == 0
    assert session["forces"] == pytest.approx([0.4, -0.2])  # 1000 and -500 steps of 0.4 mN
    assert session["limits"] == pytest.approx([2.02, 1.01])  # 1 % above the caps of 2 and 1 N


def test_a_configuration_waits_for_the_ramp(session):
    assert session["ramped"] == [[None] * 5 + [0], 0.0]  # a ramp of five ticks


def test_the_deadman_is_a_button_of_every_device(session):
    assert session["buttons"] == [False, False, True]


def test_three_axes_of_a_device_share_a_limit(session):
    assert session["held"] == []
    assert session["space"] == pytest.approx([0.4, -0.2, 0.1, 0.04, 0.08, -0.12])
    assert session["vectors"] == pytest.approx([2.02, 1.01])  # 1 % above 2 and 1 N, the caps of the force vectors


@pytest.mark.parametrize(
    ("index", "words"),
    [
        ("3=1", "is in reset mode"),
        ("9=7", "reports error 7"),
        ("0=0", "has no power"),
        ("1=0", "is not connected"),
        ("5=0", "has switched its forces off, cause forces_not_off"),
        ("5=99", "has switched its forces off, cause 99"),
    ],
)
def test_bad_status_removes_every_force_at_once(session, index, words):
    trouble, pushed, *then = session[index]
    assert trouble.startswith(f"device sn4712 {words}")
    assert pushed == pytest.approx([0.4, -0.2])
    assert then == [[0.0, 0.0]] * 2  # of both devices, at once and at the next tick


def test_closed_devices_have_no_force(session):
    assert session["after"] == [0.0, 0.0]
