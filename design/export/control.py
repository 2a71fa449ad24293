"""A block as a Python file that builds a python-control StateSpace.

python-control has no file format of its own, and a pickle would tie the file to one version of it and of Python. A
script can be read, compared line by line, imported, and run: it tests itself. Writing it needs no python-control;
running it does.
"""

from __future__ import annotations

import textwrap
from string import Template

from controller.lti import Array
from design.export.block import Block, Trial

SOURCE = Template('''\
$about
#
# statespace() is the block as a python-control StateSpace; run as a script, the file tests it.
import sys

T = $T  # [s]
A = [
$A
]
B = [
$B
]
C = [
$C
]
D = [
$D
]
TEST_INPUT = [
$test_input
]
TEST_OUTPUT = [
$test_output
]
TOLERANCE = 1e-10  # of the largest output: matrix products sum in an order of their own


def statespace():
    """The block, inputs $input and outputs $output."""
    import control

    inputs = ["$u%d" % (i + 1) for i in range($m)]
    outputs = ["$y%d" % (i + 1) for i in range($m)]
    return control.ss(A, B, C, D, T, name="$name", inputs=inputs, outputs=outputs)


def main():
    """0 where python-control answers the test vector as it should, 1 where not."""
    import control
    import numpy as np

    expected = np.array(TEST_OUTPUT).T
    found = control.forced_response(statespace(), U=np.array(TEST_INPUT).T, squeeze=False).outputs
    error = float(abs(found - expected).max() / abs(expected).max())
    print("$name: largest difference %.1e of the largest output, allowed %.0e" % (error, TOLERANCE))
    return int(not error <= TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
''')


def control_source(block: Block, test: Trial) -> str:
    """The file's text; numbers are decimals that read back to the same doubles."""
    system = block.system
    return SOURCE.substitute(
        about="\n".join(_comment(block.about)),
        name=block.name,
        T=repr(system.T),
        m=system.inputs,
        u=block.input.letter,
        y=block.output.letter,
        input=block.input.what,
        output=block.output.what,
        test_input=_rows(test.inputs),
        test_output=_rows(test.outputs),
        **{name: _rows(getattr(system, name)) for name in "ABCD"},
    )


def _comment(lines: tuple[str, ...]) -> list[str]:
    wrap = textwrap.TextWrapper(108, initial_indent="# ", subsequent_indent="#     ")
    return [part for line in lines for part in wrap.wrap(line)]


def _rows(values: Array) -> str:
    return "\n".join(f"    {row}," for row in values.tolist())
