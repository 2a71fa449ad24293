"""The short names of causes do not depend on one word, and different messages have different names."""

import pytest
from causes import CAUSES, cause_of

from haptic_loop.hw.protocol import Cause


@pytest.mark.parametrize("name", CAUSES)
def test_a_changed_word_leaves_the_cause(name):
    words = CAUSES[name].split()
    for i, word in enumerate(words):
        if word.upper() not in Cause.__members__:  # a name on the wire, which tells two causes apart
            assert cause_of(" ".join([*words[:i], "another", *words[i + 1 :]])) == f"{name}:"


def test_messages_without_a_name_stay_whole():
    assert cause_of("the design of the coupling failed at 3 Hz") == "the design of the coupling failed at 3 Hz"


def test_causes_list_the_numbers_of_messages():
    told = "encoder 2 jumped by 0.72 mm: no force can move it by 1e-05 mm in 2 ticks and stop it in the next"
    assert cause_of(told) == "jolt: 2 0.72 1e-05 2"
    assert cause_of("the controller asked for -inf, nan N, which is no force") == "no force: -inf nan"
