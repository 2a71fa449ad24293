"""A block as one C99 file: no allocation, no library, and its own test."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

import numpy as np

from controller.delay import delay
from controller.loop import Loop
from controller.lti import Array, Lti
from design.certificate import Stored

# ----------------------------------------------------------------------------------------------------
# What is exported: one state-space block, the order in which its sums are taken, and a test vector in that order.
#
# A tick is y = C z + D u, z+ = A z + B u. Every entry of y and of z+ is one sum in double precision that starts at
# 0.0 and adds, one rounded product after another, the states z_0, z_1, .. and then the inputs u_0, u_1, ..: an order
# that every language can keep, so that an exported block repeats its test vector to the last bit.


TICKS = 64  # of a test vector: longer than the delays and the fast modes of a loop


@dataclass(frozen=True)
class Signal:
    """One side of a block: m numbers of one kind."""

    letter: str
    what: str  # with its unit
    size: float  # of a test vector's numbers, in that unit


FORCE = Signal("f", "force [N]", 1.0)
DISPLACEMENT = Signal("x", "displacement [m]", 1e-3)
GIVEN_WAY = Signal("d", "displacement [m]", 1e-3)


@dataclass(frozen=True, eq=False)
class Block:
    """A square block that runs once per sampling period, from rest."""

    name: str  # "coupling" | "process"
    system: Lti  # at least one state
    input: Signal
    output: Signal
    about: tuple[str, ...]  # what it is, one line each


@dataclass(frozen=True, eq=False)
class Trial:
    """A test vector."""

    inputs: Array  # (TICKS, m)
    outputs: Array  # (TICKS, m)


class NothingToExport(ValueError):
    """The coupling has no block of the kind that was asked for."""


def coupling_block(stored: Stored) -> Block:
    """V(z), force to displacement. Raises NothingToExport where the coupling is no V in feedback."""
    V = stored.built().compliance(stored.loop.T)
    if V is None:
        raise NothingToExport("this coupling is no V in feedback around the environment; the whole process can be had")
    about = ("d = V f: what the coupling gives way by. In its loop the environment sees u = x - d, and f = Psi E u.",)
    return Block("coupling", with_a_state(V), FORCE, GIVEN_WAY, about)


def process_block(stored: Stored, with_theta: bool = True) -> Block:
    """F(z) (6), device displacements to forces; Theta is left out where the link to the devices is the delay."""
    loop = stored.loop
    theta = loop.theta if with_theta else (0,) * len(loop.theta)
    if loop.environment.walls:
        raise NothingToExport("environment.walls: contact that makes and breaks is not a linear block")
    F = delay(theta, loop.T) @ loop.sent(stored.built())
    about = (
        "f = F x: the whole discrete process; the devices get -f, held for T. Forces are not limited here.",
        _delays(loop, with_theta),
    )
    return Block("process", with_a_state(F), DISPLACEMENT, FORCE, about)


def with_a_state(system: Lti) -> Lti:
    """The same block, with a state that stays zero where it has none: C has no empty arrays."""
    if system.order:
        return system
    m = system.inputs
    return Lti(np.zeros((1, 1)), np.zeros((1, m)), np.zeros((system.outputs, 1)), system.D, system.T)


def trial(block: Block, seed: int = 0) -> Trial:
    """Normally distributed inputs and the outputs that `sequential` gives."""
    rng = np.random.default_rng(seed)
    inputs = block.input.size * rng.standard_normal((TICKS, block.system.inputs))
    return Trial(inputs, sequential(block.system, inputs))


def sequential(system: Lti, inputs: Array) -> Array:
    """Outputs (ticks, p) for inputs (ticks, m), from rest, every sum in the order that the module states."""
    rows = np.block([[system.C, system.D], [system.A, system.B]])
    z, outputs = np.zeros(system.order), []
    for u in inputs:
        sums = np.zeros(len(rows))
        for column, value in zip(rows.T, [*z, *u], strict=True):
            sums = sums + column * value
        outputs.append(sums[: system.outputs])
        z = sums[system.outputs :]
    return np.array(outputs)


def data(block: Block, test: Trial) -> dict[str, Any]:
    """The block as plain data, for JSON."""
    system = block.system
    return {
        "what": block.name,
        "about": list(block.about),
        "T_s": system.T,
        "input": block.input.what,
        "output": block.output.what,
        **{name: getattr(system, name).tolist() for name in "ABCD"},
        "test_input": test.inputs.tolist(),
        "test_output": test.outputs.tolist(),
    }


def _delays(loop: Loop, with_theta: bool) -> str:
    def shown(steps: Sequence[int]) -> str:
        return ", ".join(map(str, steps))

    theta = "included" if with_theta else "NOT included: the link to the devices must be that delay"
    return f"delays in samples: environment psi = {shown(loop.psi)}, transmission theta = {shown(loop.theta)} ({theta})"


# ----------------------------------------------------------------------------------------------------
# A block as a Python file that builds a python-control StateSpace.
#
# python-control has no file format of its own, and a pickle would tie the file to one version of it and of Python. A
# script can be read, compared line by line, imported, and run: it tests itself. Writing it needs no python-control;
# running it does.


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


SOURCE_C = Template("""\
/*
$about
 *
 * One tick:  $y = C z + D $u,  z+ = A z + B $u.  Every entry is one sum that starts at 0.0 and adds the
 * states z[0], z[1], .. and then the inputs, product by product. Compiled with IEEE doubles (FLT_EVAL_METHOD 0),
 * without contraction of a*b + c and without -ffast-math, it repeats Python's test vector to the last bit:
 *
 *     cc -std=c99 -O2 -ffp-contract=off -DHAPTIC_LOOP_TEST $file -o test && ./test
 *
 * For its declarations alone: #define HAPTIC_LOOP_DECLARATIONS_ONLY, then #include "$file".
 */
#ifndef HAPTIC_LOOP_$NAME
#define HAPTIC_LOOP_$NAME

enum { ${NAME}_CHANNELS = $m, ${NAME}_STATES = $n };

#define ${NAME}_PERIOD $T /* [s] */

typedef struct {
    double z[${NAME}_STATES];
} ${name}_state;

/* To rest. */
void ${name}_reset(${name}_state *state);

/* One tick: $input in, $output out. */
void ${name}_step(${name}_state *state, const double $u[${NAME}_CHANNELS], double $y[${NAME}_CHANNELS]);
$more_declared
#ifndef HAPTIC_LOOP_DECLARATIONS_ONLY

$tables

void ${name}_reset(${name}_state *state)
{
    int i;
    for (i = 0; i < ${NAME}_STATES; i++)
        state->z[i] = 0.0;
}

void ${name}_step(${name}_state *state, const double $u[${NAME}_CHANNELS], double $y[${NAME}_CHANNELS])
{
    double next[${NAME}_STATES], out[${NAME}_CHANNELS];
    int i, j;
    for (i = 0; i < ${NAME}_CHANNELS; i++) {
        double sum = 0.0;
        for (j = 0; j < ${NAME}_STATES; j++)
            sum += ${name}_C[i][j] * state->z[j];
        for (j = 0; j < ${NAME}_CHANNELS; j++)
            sum += ${name}_D[i][j] * $u[j];
        out[i] = sum;
    }
    for (i = 0; i < ${NAME}_STATES; i++) {
        double sum = 0.0;
        for (j = 0; j < ${NAME}_STATES; j++)
            sum += ${name}_A[i][j] * state->z[j];
        for (j = 0; j < ${NAME}_CHANNELS; j++)
            sum += ${name}_B[i][j] * $u[j];
        next[i] = sum;
    }
    for (i = 0; i < ${NAME}_STATES; i++)
        state->z[i] = next[i];
    for (i = 0; i < ${NAME}_CHANNELS; i++)
        $y[i] = out[i];
}
$more_defined
#ifdef HAPTIC_LOOP_TEST
#include <stdio.h>
#include <string.h>

$tests

int main(void)
{
    ${name}_state state;
    double out[${NAME}_CHANNELS];
    int run, k, i, wrong = 0;
    for (run = 0; run < 2; run++) { /* twice: a reset brings back the start */
        ${name}_reset(&state);
        for (k = 0; k < $ticks; k++) {
            ${name}_step(&state, test_input[k], out);
            for (i = 0; i < ${NAME}_CHANNELS; i++)
                if (memcmp(&out[i], &test_output[k][i], sizeof out[i]) != 0 && wrong++ == 0)
                    fprintf(stderr, "$name: tick %d: %a, expected %a\\n", k, out[i], test_output[k][i]);
        }
    }
    if (wrong)
        return 1;
    printf("$name: $ticks ticks repeat to the last bit\\n");
    return 0;
}
#endif /* HAPTIC_LOOP_TEST */

#endif /* HAPTIC_LOOP_DECLARATIONS_ONLY */
#endif /* HAPTIC_LOOP_$NAME */
""")

#: a coupling stands in a feedback loop that its user closes, so it can be asked before its input is known
FREE_DECLARED = """
/* $y = free + D $u: the free part, before this tick's $u is known, and D, for solving u = x - $y, $u = E(u). */
void ${name}_free(const ${name}_state *state, double $y[${NAME}_CHANNELS]);
extern const double ${name}_D[${NAME}_CHANNELS][${NAME}_CHANNELS];
"""
FREE_DEFINED = """
void ${name}_free(const ${name}_state *state, double $y[${NAME}_CHANNELS])
{
    int i, j;
    for (i = 0; i < ${NAME}_CHANNELS; i++) {
        $y[i] = 0.0;
        for (j = 0; j < ${NAME}_STATES; j++)
            $y[i] += ${name}_C[i][j] * state->z[j];
    }
}
"""


def c_source(block: Block, test: Trial, file: str) -> str:
    """The file's text; numbers are hexadecimal, so that no compiler's decimal conversion matters."""
    system, name = block.system, block.name
    words = {
        "name": name,
        "NAME": name.upper(),
        "file": file,
        "about": "\n".join(_comment_c(block.about)),
        "u": block.input.letter,
        "y": block.output.letter,
        "input": block.input.what,
        "output": block.output.what,
        "m": system.inputs,
        "n": system.order,
        "T": repr(system.T),
        "ticks": TICKS,
        "tables": "\n\n".join(
            _table(f"{'' if name == 'coupling' and letter == 'D' else 'static '}const double {name}_{letter}", matrix)
            for letter, matrix in (("A", system.A), ("B", system.B), ("C", system.C), ("D", system.D))
        ),
        "tests": "\n\n".join(
            _table(f"static const double test_{side}", values)
            for side, values in (("input", test.inputs), ("output", test.outputs))
        ),
    }
    loose = name == "coupling"
    words["more_declared"] = Template(FREE_DECLARED).substitute(words) if loose else ""
    words["more_defined"] = Template(FREE_DEFINED).substitute(words) if loose else ""
    return SOURCE_C.substitute(words)


def _comment_c(lines: Iterable[str]) -> Iterable[str]:
    for line in lines:
        harmless = " ".join(line.split()).replace("*/", "* /").replace("/*", "/ *")
        yield from textwrap.wrap(harmless, 108, initial_indent=" * ", subsequent_indent=" *     ")


def _table(head: str, values: Array) -> str:
    rows = ",\n".join(_row(row) for row in np.asarray(values))
    return f"{head}[{len(values)}][{values.shape[1]}] = {{\n{rows}\n}};"


def _row(values: Array) -> str:
    text = ", ".join(float(v).hex() for v in values)
    return "\n".join(textwrap.wrap(f"{{{text}}}", 112, initial_indent="    ", subsequent_indent="     "))


if __name__ == "__main__":
    from cli.main import door

    door("export")
