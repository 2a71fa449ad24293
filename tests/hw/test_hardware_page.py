"""The numbers of docs/hardware.md hold for the session, the bridge's options and its serial line."""

import gc
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from haptic_loop.cli import bridge
from haptic_loop.hw.haptic_device import PortLost
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.transport import SerialPort, _no_collections
from tests.checks.faults import CASES, _rehearse_case, begins_late, rehearse_late_case
from tests.sessions import in_fork

PAGE = (Path(__file__).parents[2] / "docs" / "hardware.md").read_text(encoding="utf-8")
TABLE = re.search(r"^\| fault \| ends in .*\n\|[-|]+\n((?:\|.*\n)+)", PAGE, flags=re.MULTILINE)[1]
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in TABLE.splitlines()]
#: Rows of the page whose names differ from those of their cases.
CALLED = {
    "no FORCE arrives; cable pulled": ("no FORCE arrives", "cable pulled"),
    "encoder 1, encoder 2 dies": ("encoder dies", "encoder 2 dies"),
    "e-stop at the device, at the host": ("e-stop at the device", "e-stop at the host"),
    "10 % of answers late": ("answers get late",),
}
IN_WORDS = ("no FORCE arrives; cable pulled", "10 % of answers late")  # rows that do not quote the message


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_the_pages_fault_table_equals_rehearsals(row, scenario, link_couplings, harmless):
    fault, ends, cause, zero = row
    shown = [re.search(r"[\d.]+", part)[0] for part in zero.split(";")]
    names = CALLED.get(fault, (fault,))
    cases = [next(case for case in CASES if case.name == name) for name in names]
    outcomes = [
        in_fork(rehearse_late_case, case, harmless)
        if begins_late(case)
        else _rehearse_case(case, scenario, link_couplings)[1]
        for case in cases
    ]
    times = [f"{outcome.zero_force_ms:.1f}" for outcome in outcomes]
    assert times == (shown if len(shown) == len(times) else shown * len(times))
    for outcome in outcomes:
        assert outcome.stage in ends
    if fault not in IN_WORDS:
        assert cause in outcomes[0].cause


def test_delay_defaults_match_the_page():
    (answers, percentile, guard), *_ = re.findall(r"(\d+) answers\D+(\d+)th percentile\D+([\d.]+) ms", PAGE)
    args = bridge._parser().parse_args([])
    assert (float(args.quantile), 1e3 * float(args.guard)) == (int(percentile) / 100, float(guard))
    assert int(args.measure) == LinkSettings().measure == int(answers)


def test_sessions_run_in_a_context_without_collections():
    before, frozen = gc.isenabled(), gc.get_freeze_count()
    with _no_collections():
        assert not gc.isenabled()
        assert gc.get_freeze_count() > frozen + 1000
    assert gc.isenabled() == before
    assert gc.get_freeze_count() <= frozen


@pytest.mark.parametrize("known", [True, False])
def test_serial_ports_ask_for_low_latency(known, monkeypatch):
    """A driver without a low-latency mode is no error."""
    asked = []

    class Serial:
        def __init__(self, path, baud, **options):
            self.path = path

        def set_low_latency_mode(self, on):
            asked.append((self.path, on))
            if not known:
                raise ValueError("not supported")

        def fileno(self):
            return 7

    monkeypatch.setitem(sys.modules, "serial", SimpleNamespace(Serial=Serial, SerialException=OSError))
    SerialPort("/dev/ttyUSB0", 921_600)
    assert asked == [("/dev/ttyUSB0", True)]


def test_ports_that_vanish_are_lost():
    """Every call to a port whose other end is gone raises PortLost, also a call that discards bytes."""
    other, own = os.openpty()
    with SerialPort(os.ttyname(own), None) as port:
        os.close(own)
        os.close(other)
        for call in (port.read, port.discard, lambda: port.write(b"0")):
            with pytest.raises(PortLost):
                call()
