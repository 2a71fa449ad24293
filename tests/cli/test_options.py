"""Bad options end with one line that names the option, its value and the allowed values."""

import argparse
from dataclasses import dataclass
from importlib import import_module

import numpy as np
import pytest
from messages import says

from haptic_loop.cli import options, render
from haptic_loop.cli.run import _parser as run_parser
from haptic_loop.controller.loop import DelayRange
from haptic_loop.design.certificate import named
from haptic_loop.design.files import one_line
from haptic_loop.design.result import CONDITIONS
from haptic_loop.sim.scenario import SCENARIOS, InputError, load


def parser():
    parser_of_x = options.Parser("x", "what", "python -m x")
    parser_of_x.add_argument("--count", type=options.whole(1, 9))
    parser_of_x.add_argument("--seed", type=options.whole(0))
    parser_of_x.add_argument("--length", type=options.number(1e-3, 2, "m"))
    parser_of_x.add_argument("--K", type=options.several(float, 0, 1e3, "N/m"))
    parser_of_x.add_argument("--theta", type=options.several(int))
    parser_of_x.add_argument("--mark", type=options.pair, action="append")
    parser_of_x.add_argument("--varying-delay", type=options._delay_ranges)
    parser_of_x.add_condition()
    return parser_of_x


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--count 0", "--count is 0 .. 1 to 9"),
        ("--count 1.5", "--count is '1.5', expected a whole number"),
        ("--seed=-1", "--seed is -1 .. numbers from 0"),
        ("--length nan", "--length is nan .. 0.001 to 2 m"),
        ("--length long", "--length is 'long', expected a number"),
        ("--K 1,2000", "--K is 2000 .. 0 to 1000 N/m"),
        ("--theta 1,x", "--theta is '1,x', expected whole numbers separated by commas"),
        ("--mark 1,2,3", "--mark is '1,2,3', expected two numbers separated by a comma"),
        ("--varying-delay 1", "--varying-delay is '1', expected LO,HI or LO-HI,LO-HI,.. in whole samples"),
        ("--condition any", "--condition is 'any' .. this-environment, "),
        ("--nonsense", "unknown option --nonsense (--help lists the options)"),
        ("--conut 3", "unknown option --conut .. --count"),
    ],
)
def test_bad_options_are_named(words, message):
    with pytest.raises(InputError) as caught:
        parser().parse_args(words.split())
    assert says(caught.value, message)


def test_good_options_are_parsed():
    words = "--count 3 --length 1e-3 --K 1,2 --theta 0 --mark 5000,0 --mark 1,2 --varying-delay 1-2,0-3"
    args = parser().parse_args(words.split())
    assert (args.count, args.length, args.K, args.theta) == (3, 1e-3, (1.0, 2.0), (0,))
    assert args.mark == [(5000.0, 0.0), (1.0, 2.0)]
    assert options.per_channel("--theta", args.theta, 3) == (0, 0, 0)
    assert options.delay_range(args.varying_delay, load().loop("I"), 9) == DelayRange((1, 0), (2, 3))
    assert options.delay_range(options._delay_ranges("1,2"), load().loop("I"), 9) == DelayRange((1, 1), (2, 2))
    with pytest.raises(InputError, match="--K has 2 entries, expected 3"):
        options.per_channel("--K", args.K, 3)


@dataclass(frozen=True)
class Report:
    name: str = render.figure("loop")
    growth: float | None = render.figure("growth [1/s]", "{:+.2f}")
    holds: bool = True


def test_a_reports_field_defines_row_and_key(capsys):
    """A field's declaration sets its row in tables, and its name is the key in JSON."""
    reports = [Report("a", 1.0), Report("b", None, False)]
    assert list(render.rows_of(reports[0])) == [("loop", "a"), ("growth [1/s]", "+1.00")]
    assert list(render.rows_of(reports[1])) == [("loop", "b"), ("growth [1/s]", None)]
    assert render.plain(reports[1]) == {"name": "b", "growth": None, "holds": False}
    screen = render.console(argparse.Namespace(json=None))
    screen.print(render.facts("a loop", render.rows_of(reports[0])))
    lines = capsys.readouterr().out.splitlines()
    assert [part.strip() for part in lines[3].strip("│").split("│")] == ["growth [1/s]", "+1.00"]


def test_messages_quote_at_most_eighty_printable_characters():
    long, path = "y" * 300, "/tmp/" + "p" * 100 + "/a.toml"
    line = one_line(f"{path}: T = '{long}' and the device's\n x{long}\x1b[31m, 'I', 'II'")
    assert path in line
    assert line.endswith("x1b[31m, 'I', 'II'")
    assert max(len(word) for word in line.split() if "/" not in word) == 80
    assert one_line("the scenario's words " + "and more " * 20 + "'x'").endswith("'x'")


@pytest.mark.parametrize(
    ("words", "case"),
    [("", "I"), ("--reference II", "II"), ("--case none", "none")],
)
def test_reference_or_case_sets_the_case(words, case):
    assert run_parser().parse_args(words.split()).case == case


def test_reference_and_case_must_agree():
    with pytest.raises(InputError, match="--reference I with --case II: give one of them"):
        run_parser().parse_args(["--reference", "I", "--case", "II"])
    with pytest.raises(InputError, match="replace --case none by --coupling none"):
        run_parser().parse_args(["--reference", "II", "--case", "none"])


def test_every_message_lists_the_conditions_alike():
    expected = f"is 'foo', allowed are {', '.join(CONDITIONS)}"
    for refused in (options.condition, named):
        with pytest.raises((argparse.ArgumentTypeError, ValueError), match=expected):
            refused("foo")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--delta 1.37 1.37", r"unexpected word 1.37 \(several numbers are written with commas, as 1,2,3\)"),
        ("extra", r"^unexpected word extra \(--help lists the options\)"),
        ("scenario", "^unexpected word scenario, did you mean --scenario"),
        ("--delta 1.3,1.3,1.3", r"--delta has 3 entries, expected 2 \(one per device\) or 1"),
    ],
)
def test_numbers_are_one_per_device(words, said):
    with pytest.raises(InputError, match=said):
        options.scenario_from(run_parser().parse_args(["--scenario", "omega-space", *words.split()]))


def scenario_of(words):
    return options.scenario_from(run_parser().parse_args(words.split()))


def test_known_device_and_delta_combine():
    """Bounds of --known-device replace those of the scenario, with and without --delta."""
    bounds = "--scenario omega-pair-known --known-device 0.06,14500,0.5,5"
    scenario = scenario_of(f"{bounds} --delta 1.2 --theta 2,2 --latency 1e-4 --T 1e-3")
    assert {bound.transmission_damping_max for bound in scenario.known_devices} == {5.0}
    assert scenario.known_devices == scenario_of(bounds).known_devices
    assert (scenario.delta, scenario.theta, scenario.T) == ((1.2, 1.2), (2, 2), 1e-3)
    assert scenario.latency == ((0.0, 1e-4),) * 2


OWN_ENVIRONMENT = """
from haptic_loop.controller.environment import Network, Spring, environment

ENDS = ("contact 1", "contact 2")
NETWORK = Network(ENDS, springs=(Spring(ENDS, 100.0, 1.0),))

class Own:
    contacts = ENDS
    def E(self, T):
        return environment(NETWORK, T)
"""


def test_own_environments_are_computed_for_the_period(tmp_path):
    (tmp_path / "own.py").write_text(OWN_ENVIRONMENT)
    scenario = scenario_of(f"--T 5e-4 --environment {tmp_path}/own.py:Own")
    stiffness = 100.0 + 1.0 / 5e-4  # backward Euler: K + B / T
    np.testing.assert_allclose(scenario.loop("I").E().D, stiffness * np.array([[1, -1], [-1, 1]]), rtol=1e-6)


OWN_POPULATION = """
from haptic_loop.sim.scenario import load

class Own:
    def draw(self, rng, n):
        return [load().human[0]] * n
"""


@pytest.mark.parametrize(
    ("command", "words", "option"),
    [
        ("audit", "--rigid --K 100 --B 0 --world scene.xml", "--world"),
        ("audit", "--rigid --K 100 --B 0 --environment own.py:Own", "--environment"),
        ("audit", "--rigid --K 100 --B 0 --lam 0", "--lam"),
        ("audit", "--rigid --K 100 --B 0 --latency 1e-4,2e-4", "--latency"),
        (
            "audit",
            "--rigid --K 100 --B 0 --scenario omega-pair-known" + 2 * " --known-device 0.06,14500,0.5,5",
            "--known-d",
        ),
        ("audit", "--device omega.3 --world scene.xml", "--world"),
        ("audit", "--device omega.3 --environment own.py:Own", "--environment"),
        *(("audit", f"--devices {words}", words.split()[0]) for words in ("--T 1e-3", "--condition any-environment")),
        *(
            ("audit", f"--devices {words}", words.split()[0])
            for words in ("--scenario three-rigid", "--out x", "--details")
        ),
        ("audit", "--scenario world-cube --condition this-environment", "--condition"),
        ("audit", "--scenario world-cube --varying-delay 0,1", "--varying-delay"),
        ("audit", "--scenario world-cube --details", "--details"),
        ("design", "--scenario world-cube --ranges 10%", "--ranges"),
        ("design", "--scenario world-cube --varying-delay 0,1", "--varying-delay"),
        ("design", "--scenario world-cube --limiter", "--limiter"),
        ("design", "--scenario world-cube --no-limiter", "--no-limiter"),
        ("design", "--scenario world-cube --objective sup", "--objective"),
        ("run", "--scenario world-cube --no-limiter", "--no-limiter"),
        ("run", "--scenario world-cube --band 1,20", "--band"),
        ("run", "--scenario world-cube --details", "--details"),
        ("run", "--lam 0,0 --reference II", "--reference II with --lam"),
        ("run", "--lam 0,0 --case II", "--case II with --lam"),
        ("run", "--scenario world-cube --case II", "--case II"),
        ("design", "--scenario world-cube --lam 0", "--lam"),
        ("validate", "--scenario world-cube --reference II", "--reference II"),
        ("audit", "--rigid --K 1000 --B 0 --reference II", "--reference II"),
        ("run", "--varying-delay 1,2 --pattern bursty --playout", "--pattern"),
        ("validate", "--scenario world-cube --links 2", "--links"),
        ("validate", "--scenario world-cube --engine exact", "--engine"),
        ("validate", "--scenario world-cube --traces all", "--traces"),
        ("validate", "--scenario world-cube --shards 2", "--shards"),
        ("validate", "--scenario world-cube --environments ranges", "--environments"),
        ("validate", "--scenario world-cube --no-limiter", "--no-limiter"),
        ("validate", "--engine exact --traces all", "--traces"),
        ("validate", "--duration 0 --traces all", "--traces"),
        ("zwidth", "--lam 0,0", "--lam"),
        ("zwidth", "--reference I", "--reference"),
        ("zwidth", "--case II", "--case II"),
        ("bridge", "--port /dev/null --arm --seed 3", "--seed"),
        ("identify", "--port /dev/null --arm --seed 3", "--seed"),
        ("bridge", "--rehearse --deadman FILE", "--deadman"),
        ("validate", "--human humans.py:Own --links 2 --humans 2 --duration 0", "--links 2 with --human"),
        ("validate", "--human population.toml --humans 2 --duration 0", "[population]"),
        ("bridge", "--port force-dimension --arm --baud 9600", "--baud"),
        *(("identify", f"--rehearse {words}", words.split()[0]) for words in ("--psi 0", "--lam 0", "--reference II")),
        ("identify", "--rehearse --environment own.py:Own", "--environment"),
        ("identify", "--rehearse --known-device 0.06,14500,0.5,5", "--known-device"),
        ("view", "--coupling none --script 0:published --video x.gif", "--coupling none with --script 0:published"),
    ],
)
def test_options_without_effect_are_refused(command, words, option, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hand = "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
    (tmp_path / "population.toml").write_text(f"{hand}{hand}[population]\nlinks = 2\n")
    (tmp_path / "humans.py").write_text(OWN_POPULATION)
    with pytest.raises(InputError) as caught:
        import_module(f"haptic_loop.cli.{command}").main(words.split())
    message = str(caught.value)
    assert option in message
    assert "No such file" not in message
    assert "\n" not in message


def test_the_bridge_reads_its_file_first(tmp_path, monkeypatch):
    """A session loads MuJoCo and measures the link, which takes seconds, so a wrong file is refused before."""
    monkeypatch.setattr("haptic_loop.cli.bridge.session_for", None)
    (tmp_path / "bad.json").write_text("{}")
    bridge = import_module("haptic_loop.cli.bridge").main
    for coupling, said in ((tmp_path / "bad.json", "is no stored coupling"), ("frob", "allowed are")):
        with pytest.raises(InputError, match=said):
            bridge(["--rehearse", "--coupling", str(coupling)])


def test_two_references_are_refused(tmp_path):
    """A scenario's lam is the reference of both cases, so --reference II would change nothing."""
    assert load().replace(lam=(0, 1)).loop("I").lam == load().replace(lam=(0, 1)).loop("II").lam
    text = (SCENARIOS / "omega-pair.toml").read_text()
    (tmp_path / "own.toml").write_text(text.replace("psi = ", "lam = [0, 1]\npsi = "))
    for words in ("--reference II", "--case II"):
        with pytest.raises(InputError, match=f"^{words} with lam of the scenario"):
            scenario_of(f"--scenario {tmp_path}/own.toml {words}")


def test_long_tables_leave_out_less_important_rows():
    """A row without a name belongs to the row before it, and rows without a text do not count."""
    rows = [(f"row {i}", "1") for i in range(14)] + [("spare", "2"), ("", "3"), ("absent", None), ("last", "4")]
    kept, (line,) = render.shortened(rows, ("row 3", "spare", "row 5"))
    assert kept == [row for row in rows if row[0] not in ("row 3", "spare", "", "absent")]
    assert line.endswith(": row 3; spare.")
    assert render.shortened(rows[:15], ("row 3",)) == (rows[:15], [])
    assert len(render.shortened(rows, ("row 3", "spare", "row 5"), others=1)[0]) == 14
