"""A block as one C99 file: no allocation, no library, and its own test."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from string import Template

import numpy as np

from controller.lti import Array
from design.export.block import TICKS, Block, Trial

SOURCE = Template("""\
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
        "about": "\n".join(_comment(block.about)),
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
    return SOURCE.substitute(words)


def _comment(lines: Iterable[str]) -> Iterable[str]:
    for line in lines:
        harmless = " ".join(line.split()).replace("*/", "* /").replace("/*", "/ *")
        yield from textwrap.wrap(harmless, 108, initial_indent=" * ", subsequent_indent=" *     ")


def _table(head: str, values: Array) -> str:
    rows = ",\n".join(_row(row) for row in np.asarray(values))
    return f"{head}[{len(values)}][{values.shape[1]}] = {{\n{rows}\n}};"


def _row(values: Array) -> str:
    text = ", ".join(float(v).hex() for v in values)
    return "\n".join(textwrap.wrap(f"{{{text}}}", 112, initial_indent="    ", subsequent_indent="     "))
