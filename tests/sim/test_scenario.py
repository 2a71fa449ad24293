"""Scenarios are strict: every impossible one gives one line that names the field."""

import msgspec
import numpy as np
import pytest
from messages import says
from shared import FIGURE_4

from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import Spring
from haptic_loop.controller.loop import DeviceBounds
from haptic_loop.design.coverage import robustness_nearby
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.transparency import transparency
from haptic_loop.models.device import RigidDevice
from haptic_loop.models.human import Human, Link
from haptic_loop.sim.report import friction_left_out
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import CASES, SCENARIOS, InputError, built_in, load, parse

TEXT = (SCENARIOS / "omega-pair.toml").read_text()

BAD = [
    ("theta = [1, 2]", "theta = [1, 1.5]", "theta #2 = 1.5: expected `int`, got `float`"),
    ("theta = [1, 2]", "theta = [1]", "theta has 1 entries .. 2 contacts"),
    ("theta = [1, 2]", "theta = [1, -1]", "theta #2 is -1 .. 0 to 1000 samples"),
    ("theta = [1, 2]", "theta = [1, true]", "theta #2 = True: expected `int`"),
    ("psi = [0, 0]", "psi = [0, 0, 0]", "psi has 3 entries"),
    ("psi = [0, 0]", "psi = [0, 0]\nlam = [2, 2]", "lam #1 is 2 .. 0 to theta + psi = 1 samples"),
    ("T = 1.2e-3", "T = 1.2", "T is 1.2 .. 1e-06 to 0.1 s"),
    ("T = 1.2e-3", "T = nan", "T is nan"),
    ("T = 1.2e-3", "T = '1.2 ms'", "T = '1.2 ms': expected `float`, got `str`"),
    ("T = 1.2e-3", "T == 1", "not valid TOML"),
    ("name = ", "nam = ", "`nam` .. `name`"),
    ("motor_mass = 0.06 ", "motor_mass = -0.06", "device #1: motor_mass is -0.06 .. 1e-09 to 1000 kg"),
    ("motor_mass = 0.06 ", "motor_mas = 0.06", "`motor_mas` .. `motor_mass`"),
    ("damping = 1.37 ", "damping = 1.37\ndelta = 2.0", "delta is 2 N s/m .. values in (0, damping = 1.37]"),
    ('kind = "compliant" ', 'kind = "soft"', "device #1.kind = 'soft': invalid value 'soft' .. 'compliant'"),
    (
        "damping = 1.37 ",
        "damping = 1.37\nfriction = 0.2\nfriction_max = 0.1",
        "device #1: friction_max is 0.1 .. 0.2 to 1000 N",
    ),
    ("mass = 0.3", "mass = 3e5", "human #1.links #1: mass is 300000 .. 0 to 1000 kg"),
    ("frequency = 0.6", "frequency = inf", "frequency is inf"),
    ("stiffness = 800.0", "stiffness = -800.0", "stiffness between contact 1 and mass is -800.0"),
    ("stiffness = 800.0", "stiffness = 1e-300", "stiffness between contact 1 and mass is 1e-300, allowed in"),
    ("mass = 1.0 }", "mas = 1.0 }", "masses lists 'mas', which no spring or wall reaches"),
    ("channel = 1", "channel = 3", "tap.channel is 3 .. 1 to 2"),
    ("[tap]", "[tapp]", "`tapp` .. `tap`"),
    ("duration = 15.0", "duration = 0.0", "duration is 0"),
]


def test_a_misspelt_scenario_gets_a_suggestion():
    with pytest.raises(InputError, match=r"\(did you mean world-cube\?\); give a TOML file"):
        load("world-cub")


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[new for _, new, _ in BAD])
def test_bad_scenarios_give_one_line(old, new, message):
    assert old in TEXT
    with pytest.raises(InputError) as caught:
        parse(TEXT.replace(old, new, 1), "mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
    assert says(caught.value, message)
    assert "\n" not in str(caught.value)


def test_scenarios_need_only_five_fields():
    bare = """
name = "bare"
T = 1e-3
theta = [3, 1]
device = ["omega.3", "omega.3"]
[environment]
contacts = ["a", "b"]
springs = [{ between = ["a", "b"], stiffness = 200.0 }]
"""
    scenario = parse(bare)
    assert scenario.psi == (0, 0)
    phases = [human.voluntary.phase for human in scenario.human]
    assert phases == [0.0, np.pi / 2], "the hands must move apart, so that they feel the spring"
    assert scenario.digest == parse(bare.replace("theta", "psi = [0, 0]\ntheta")).digest
    assert scenario.replace(theta=(1, 1)).human == scenario.human
    for empty, expected in (
        ("psi", "2 contacts"),
        ("human", "2, one for each device"),
    ):
        with pytest.raises(InputError, match=rf"{empty} has 0 .* {expected}"):
            parse(bare.replace("theta", f"{empty} = []\ntheta"))
    with pytest.raises(InputError, match=r"^x: missing T, theta; every scenario has name, T, theta, device, environ"):
        parse(bare.replace("T = 1e-3\ntheta = [3, 1]\n", ""), "x")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nix.toml", "No such file or directory; give a TOML file or one of: omega-held, omega-pair"),
        (".", "is a folder, expected a file"),
    ],
)
def test_folders_and_missing_files_are_refused(name, message):
    with pytest.raises(InputError, match=message):
        load(name)


def test_a_number_is_refused_as_a_scenario():
    with pytest.raises(InputError, match=r"scenario is 3 \(int\), expected a TOML file or one of: .*omega-pair"):
        load(3)


def test_a_binary_file_is_refused(tmp_path):
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        load(tmp_path / "x.toml")


@pytest.mark.parametrize("name", built_in())
def test_built_in_scenarios_load(name):
    assert load(name).name == name


def test_the_default_scenario_is_the_papers():
    scenario = load()
    assert scenario.environment == FIGURE_4
    assert (scenario.T, scenario.theta, scenario.psi, scenario.delta) == (1.2e-3, (1, 2), (0, 0), (1.37, 1.37))
    assert scenario.reference_delays("I") == (1, 2)
    assert scenario.reference_delays("II") == (0, 0)


def test_titles_name_the_delay_of_the_reference():
    """The reference is late by `lam` samples; if lam is absent, by theta + psi in case I and by 0 in case II."""
    own = load("omega-pair").replace(name="own", theta=(1, 1), psi=(0, 1))
    titles = {(case, lam): own.replace(lam=lam).title(case) for case in CASES for lam in (None, (0, 0), (1, 0), (1, 2))}
    late, without = "own, reference [1, 0] samples late", "own, reference without delay"
    each = {"none": ["own, no coupling"] * 4, "I": ["own", without, late, "own"], "II": [without, without, late, "own"]}
    assert list(titles.values()) == [title for case in CASES for title in each[case]]


def test_replaced_fields_are_checked():
    scenario = load()
    assert scenario.replace(delta=(2.0, 0.8)).delta == (2.0, 0.8)
    for change, message in [
        ({"theta": (1, 2, 3)}, "theta has 3 entries"),
        ({"delta": (1.0, -1.0)}, r"delta #2 is -1.*0 to 10000 N s/m"),
        ({"delta": (1.0,)}, "delta.* 1 .* 2 devices"),
    ]:
        with pytest.raises(InputError, match=message):
            scenario.replace(**change)


@pytest.mark.parametrize("name", built_in())
def test_replacing_nothing_changes_nothing(name):
    scenario = load(name)
    same = scenario.replace(name=scenario.name)
    assert same == scenario
    assert same.digest == scenario.digest


def test_scripts_may_use_lists_arrays_and_integers():
    """Lists, NumPy's arrays and numbers, and integers for floats give the same scenario as tuples and floats."""
    scenario = load().replace(theta=[1, 3], psi=np.array([1, 0]), T=np.float64(1e-3), duration=2, delta=np.ones(2))
    assert (scenario.theta, scenario.psi, scenario.delta) == ((1, 3), (1, 0), (1.0, 1.0))
    assert [type(value) for value in (*scenario.psi, scenario.T, scenario.duration)] == [int, int, float, float]
    assert scenario.digest == load().replace(theta=(1, 3), psi=(1, 0), T=1e-3, duration=2.0, delta=(1.0, 1.0)).digest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"theta": (1.5, 1)}, "theta #1 = 1.5: expected `int`, got `float`"),
        ({"theta": np.array([1.5, 1])}, "theta #1 = 1.5: expected `int`, got `float`"),
        ({"theta": (True, 1)}, "theta #1 = True: expected `int`, got `bool`"),
        ({"theta": 1}, "theta = 1: expected `array`, got `int`"),
        ({"theta": "12"}, "theta = '12': expected `array`, got `str`"),
        ({"theta": {1, 2}}, "theta holds {1, 2} (set), which no scenario can have"),
        ({"T": "1"}, "T = '1': expected `float`, got `str`"),
        ({"T": True}, "T = True: expected `float`, got `bool`"),
        ({"T": 1j}, "T holds 1j (complex), which no scenario can have"),
        ({"name": b"x"}, "name holds b'x' (bytes), which no scenario can have"),
        ({"human": None}, "human: expected `array`, got `null`"),
        ({"device": ("a", "b")}, "device #1: device is 'a' .. omega.3"),
        ({"device": (1, 2)}, "device #1 = 1: expected `object`, got `int`"),
        ({"delta": 1.0}, "delta = 1.0: expected `array`, got `float`"),
        ({"delta": (1.0, "x")}, "delta #2 = 'x': expected `float`, got `str`"),
        ({"delta": (float("nan"), 1.0)}, "delta #1 is nan .. 0 to 10000 N s/m"),
        ({"thta": (1, 1)}, "`thta` .. `theta`"),
    ],
)
def test_replacing_is_as_strict_as_a_file(change, message):
    with pytest.raises(InputError) as caught:
        load().replace(**change)
    assert says(caught.value, message)


def test_damping_and_other_fields_are_replaced_together():
    """A new damping keeps every other new field, whether fields are replaced together, in two steps or one by one."""
    known = load("omega-pair-known")
    wider = DeviceBounds(0.06, 14500.0, 0.5, 5.0)
    changes = {
        "device": [msgspec.structs.replace(one, guaranteed=wider, force_limit=3.0) for one in known.device],
        "theta": (2, 3),
        "latency": ((0.0, 1e-4), (0.0, 2e-4)),
        "human": known.human[::-1],
        "environment": load("omega-pair-ranges").environment,
    }
    together = known.replace(delta=(1.0, 0.9), **changes)
    assert together == known.replace(**changes).replace(delta=(1.0, 0.9))
    assert together.known_devices == (wider, wider)
    assert together.delta == (1.0, 0.9)
    assert [one.force_limit for one in together.device] == [3.0, 3.0]
    reversed_ = known
    for name in reversed(changes):
        reversed_ = reversed_.replace(delta=(1.0, 0.9), **{name: changes[name]})
    assert reversed_ == together


def test_delta_applies_to_the_new_devices():
    rigid = {"kind": "rigid", "damping": 2.0}
    assert load().replace(delta=(1.0, 0.5), device=[rigid, rigid]).device == (
        RigidDevice(damping=1.0),
        RigidDevice(damping=0.5),
    )
    with pytest.raises(InputError, match=r"delta.* 2 .* 1 devices"):
        load().replace(delta=(1.0, 0.5), device=[rigid])


def test_devices_and_environments_may_move_to_space():
    pair, space = load(), load("omega-space")
    moved = pair.replace(device=space.device, human=space.human)
    assert moved.environment.contacts == tuple(f"contact {i}.{axis}" for i in (1, 2) for axis in "xyz")
    stiffness = moved.environment.matrices()[2]
    flat = pair.environment.matrices()[2]
    alike = [
        [moved.environment.nodes().index(f"{name}.{axis}") for name in ("contact 1", "contact 2", "mass")]
        for axis in "xyz"
    ]
    for own in alike:  # each axis has the springs of the network on one axis
        np.testing.assert_array_equal(stiffness[np.ix_(own, own)], flat)
    assert space.replace(environment=pair.environment).environment == moved.environment
    assert [one.damping for one in pair.replace(device="omega.3").device] == [1.37, 1.37]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"human": 4}, "human has 4 entries, expected 2, one for each device"),
        ({"theta": 4}, "theta has 4 entries, expected 2, one for each device"),
        ({"psi": 1}, "psi has 1 entries, expected 2, one for each device"),
        ({"lam": 3}, "lam has 3 entries, expected 2, one for each device"),
        ({"latency": 3}, "latency has 3 entries, expected 2, one for each device"),
        ({"delta": 6}, "delta has 6 entries for 2 devices"),
    ],
)
def test_lists_in_space_are_per_device(change, message):
    space = load("omega-space")
    entry = {"human": space.human[0], "latency": (0.0, 1e-4)}
    ((name, count),) = change.items()
    with pytest.raises(InputError) as caught:
        space.replace(**{name: [entry.get(name, 1)] * count})
    assert str(caught.value) == message


def test_device_axes_must_be_as_many_as_contacts():
    plane = msgspec.structs.replace(load("omega-space").device[0], axes=2)
    network = load("omega-space").environment
    with pytest.raises(InputError) as caught:
        load().replace(device=[plane, plane], environment=network, theta=(1, 1), psi=(0, 0))
    assert says(caught.value, "device has 2 entries with 4 free axes .. 6 contacts (left.x, left.y")


@pytest.mark.parametrize("case", ["III", "i", "", None, 1])
def test_an_unknown_case_is_refused(case):
    with pytest.raises(InputError) as caught:
        load().loop(case)
    assert str(caught.value) == f"case is {case!r}, allowed are none, I, II"


def test_the_digest_changes_with_the_delays():
    scenario = load()
    assert scenario.digest == load().digest
    assert scenario.digest != scenario.replace(theta=(1, 3)).digest


FALCON = """
name = "mine"
T = 1e-3
theta = [0, 0]
psi = [0, 0]
device = {device}
human = [
    {{ links = [{{ mass = 0.3, damping = 3.0, stiffness = 200.0 }}] }},
    {{ links = [{{ mass = 0.3, damping = 3.0, stiffness = 200.0 }}] }},
]
[environment]
contacts = ["a", "b"]
springs = [{{ between = ["a", "b"], stiffness = 100.0 }}]
"""


def test_given_values_override_the_catalogue():
    """A given value replaces the published one; a field without either has the default of the device's class."""
    both = parse(FALCON.format(device='[{ device = "falcon", damping = 0.5 }, "omega.3"]'))
    falcon, omega = both.device
    assert (falcon.damping, falcon.force_limit, falcon.encoder_step, falcon.mass) == (0.5, 8.0, 63.5e-6, 0.25)
    assert (omega.damping, omega.force_limit) == (1.37, 12.0)
    soft = parse(
        FALCON.format(device='[{ device = "falcon", damping = 0.5, delta = 0.4, force_limit = 3.0 }, "omega"]')
    )
    assert soft.delta == (0.4, 1.37)
    assert soft.device[0].force_limit == 3.0
    assert parse(FALCON.format(device='"omega.3"')).delta == (1.37, 1.37)
    flexible = parse(FALCON.format(device='[{ device = "touch", kind = "compliant", damping = 0.5 }, "omega"]')).device[
        0
    ]
    assert (type(flexible).__name__, flexible.handle_mass, flexible.force_limit) == ("CompliantDevice", 0.19, 3.3)
    assert load().replace(device=[{"device": "falcon", "damping": 0.5}] * 2).delta == (0.5, 0.5)


def test_too_many_devices_are_refused():
    text = """
name = "many"
T = 1e-3
device = "omega.3"
theta = {delays}
psi = {delays}
[environment]
contacts = {contacts}
springs = [{springs}]
"""

    def channels(n):
        contacts = [f"c{i}" for i in range(n)]
        springs = ", ".join(f'{{ between = ["{c}", "ground"], stiffness = 100.0 }}' for c in contacts)
        return parse(text.format(delays=[0] * n, contacts=contacts, springs=springs)).channels

    assert channels(16) == 16
    with pytest.raises(InputError, match=r"environment\.contacts has 50 entries.*1 to 32"):
        channels(50)


def test_too_long_hands_are_refused():
    one = Link(mass=0.3, damping=3.0, stiffness=200.0)
    assert len(Human(links=(one,) * 500).links) == 500
    with pytest.raises(ValueError, match=r"links has 501 entries.*1 to 500"):
        Human(links=(one,) * 501)
    links = ", ".join(["{ mass = 0.3, damping = 3.0, stiffness = 200.0 }"] * 501)
    human = f"{{ links = [{links}] }}"
    with pytest.raises(InputError, match=r"human.*links has 501 entries.*1 to 500"):
        parse(FALCON.format(device='"omega.3"').replace("human = [", f"human = [{human},", 1))


def test_the_stiffest_spring_has_no_stiffer_vertex():
    network = FIGURE_4.__class__(contacts=("a",), springs=(Spring(("a", "ground"), 1e12),))
    stiffest = load("one-wall").replace(environment=network)
    assert robustness_nearby(stiffest.loop("I"), SpringDamper([2000.0], [2.0])) is None


def test_an_environment_without_force_is_refused():
    network = FIGURE_4.__class__(contacts=("a",), springs=(Spring(("a", "ground"), 0.0),))
    with pytest.raises(InputError, match=r"environment has no force: all springs, dampers and masses are 0"):
        load("one-wall").replace(environment=network)
    loop = msgspec.structs.replace(load("one-wall").loop("I"), environment=network)
    with pytest.raises(ValueError, match=r"environment: it has no force at any frequency"):
        design_by_kind(loop, "spring-damper")
    with pytest.raises(ValueError, match=r"environment: it has no force at any frequency"):
        transparency(loop.F(SpringDamper([2000.0], [2.0])), loop.E(), loop.lam)


@pytest.mark.parametrize("kind", ["rigid", "compliant"])
@pytest.mark.parametrize(("name", "most"), [("touch", 0.26), ("phantom-premium", 0.04)])
def test_published_friction_reaches_a_scenario_as_a_bound(name, most, kind):
    listed = f'{{ device = "{name}", kind = "{kind}", damping = 0.5 }}'
    scenario = parse(FALCON.format(device=f'[{listed}, "omega.3"]'))
    assert [(d.friction, d.friction_max) for d in scenario.device] == [(0.0, most), (0.0, None)]
    remark = f"Friction of device #1: at most {most:g} N (published); no simulation or proof uses it."
    assert friction_left_out(scenario.device) == [remark]


def test_measured_friction_replaces_the_published_bound():
    listed = '{ device = "touch", damping = 0.5, friction = 0.3 }'
    device = parse(FALCON.format(device=f'[{listed}, "omega.3"]')).device[0]
    assert (device.friction, device.friction_max) == (0.3, None)
    assert friction_left_out([device]) == []


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ('"falcon"', "device #1: nobody publishes damping [N s/m] of falcon: give it beside `device`"),
        ('["omega.3", "inverse3"]', "device #2: nobody publishes damping [N s/m] and force_limit [N] of inverse3"),
        ('["omega.3", "falkon"]', "device #2: device is 'falkon' .. falcon .. omega.3"),
        ('[{ device = "falcon", damping = -1.0 }, "omega"]', "device #1: damping is -1"),
        ('[{ device = "falcon", damping = 1.0, mas = 1.0 }, "omega"]', "`mas` .. `mass`"),
    ],
)
def test_incomplete_or_unknown_devices_are_refused(device, message):
    with pytest.raises(InputError) as caught:
        parse(FALCON.format(device=device))
    assert says(caught.value, message)


def test_too_many_delay_states_are_refused():
    """The message has the delays of every channel, because a single number on the command line counts for each."""
    words = r"^theta \[999, 999\] and psi \[0, 0\] .* 1998 samples in all.*1000: each .* state, .*about 8 s"
    with pytest.raises(ValueError, match=words):
        load().replace(theta=(999, 999))


def test_traces_beyond_memory_are_refused_early():
    with pytest.raises(InputError, match=r"duration: 1e\+06 s need .* GiB of .*, .* are free:.* s"):
        run(assemble(load().replace(duration=1e6), NoCoupling()))
