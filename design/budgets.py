"""Budgets of the searches, each with the measurement that set it, and checks of the size of a proof and of a sweep.

A search ends because it has converged, because a proof or a bound decides, or because one of these budgets is spent.
No clock ends it unless the user sets a time limit, so that results do not depend on the load of the machine. Work is
counted from the sizes of matrices and numbers (`haptic_loop.controller.arithmetic.spend`); one unit takes about a
second on one core. The numbers were measured on 23 loops, 22 of which are n0 to o13 in benchmarks/loops, on a core of
an AMD EPYC, 2.4 GHz.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from haptic_loop.controller.arithmetic import TooLong, within
from haptic_loop.controller.lti import Lti

# Work that is counted [units] -----------------------------------------------------------------------------------------

#: Exact arithmetic for one coupling. A proof over 100 states takes 0.3, and a proof over 800, the largest, takes 30.
EXACT = 60.0
#: A sweep, or a search by many of them. A sweep takes 0.003 for two or three devices and 0.007 for eight.
SWEEPS = 60.0
#: The search for larger bases of an optimal coupling. The slowest of the 23 loops (o11) takes 19.
GROWTH = 60.0
#: The search between the vertices of ranges, for one coupling. It sweeps about 500 times for each choice of optional
#: springs.
RANGES = 60.0

# Sizes and numbers of the bases of an optimal coupling ----------------------------------------------------------------

#: Largest number of states of a loop with a basis. Design and proof of a loop with 268 states take 8 units (n6).
BASIS_STATES = 270
#: Largest cost of the proofs of a basis, environments * states^2.7. It equals 30 proofs over 112 states.
BASIS_PROOFS = 30 * 112**2.7
#: Largest number of unknowns of a basis with filters between all channels, for this-environment alone (ten seconds).
BASIS_UNKNOWNS = 1600
#: Largest (unknowns x channels) of any other basis: with fewer filters, or more conditions (also ten seconds).
BASIS_BESIDE = 3500
#: Number of successive bases without a certified coupling after which no larger basis is tried. Loops with ranges have
#: no such limit.
UNPROVED_BASES = 2
#: Largest number of bases whose couplings are tried at every vertex of ranges. The best basis is tried first, and the
#: first proved coupling ends the trials.
RANGED_BASES = 3

# Sizes of proofs, and rounds of searches. Normally a search converges earlier, in the number of rounds in brackets ----

#: Largest number of states of a proved block. A proof takes 0.3 s at 100, 1 s at 200, 5 s at 400 and 30 s at 800.
PROOF_STATES = 800
#: Rounds of cutting planes for a multiplier (8 for sim/scenarios/one-wall.toml), and number of rounds without progress
#: that end them.
MULTIPLIER_ROUNDS, MULTIPLIER_STALLED = 40, 3
#: Largest number of rows of a block whose multiplier is searched. Twelve devices with limited forces have 24 rows.
MULTIPLIER_ROWS = 24
#: Rounds of a search for gains, each with more frequencies (3 for case I). Then the numbers of steps: to rank the
#: starts once (only above 12 channels), in a round above 12 channels, and in a round up to 12 channels.
GAIN_ROUNDS, GAIN_STEPS = 8, (15, 60, 100)
#: Rounds that add frequencies to a design by Theorem 4. Only delays of at least a hundred samples need such rounds.
THEOREM_4_ROUNDS = 12
#: Steps of the sequence of convex problems for gains (2 for case I).
SEQUENCE_STEPS = 60
#: Designs for different shares of the damping, until the coupling satisfies a second condition (2 for one-wall.toml).
LESS_DAMPING_ROUNDS = 6
#: Rounds that add frequencies to the program of an optimal coupling (4 for case I).
PROGRAM_SWEEPS = 6
#: For the bound on linear couplings: rounds that add frequencies, largest number of sums of its coefficients s_k that
#: are zero because of delays (docs/theory.md), and intervals of its integral (2 rounds, 568 intervals: cases I, II).
BOUND_SWEEPS, BOUND_SUMS, BOUND_INTERVALS = 6, 240, 20_000
#: Convex problems for a coupling of fixed order (44 for case I).
FIXED_ORDER_PROBLEMS = 100
#: For known-device: rounds of cuts for the least share of the damping with fixed beta, and rounds of tangents for beta
#: and multipliers (4 cuts and 11 rounds for the pair of omega.3 with known transmissions).
BETA_CUTS, BETA_ROUNDS = 40, 60
#: Numbers of points that a search between the vertices of ranges tries: RANGE_EDGES on all edges together, and at least
#: RANGE_ALONG[0] and at most RANGE_ALONG[1] on each edge. With six or seven parameters, the least number for each edge
#: gives more than RANGE_EDGES in total. With more, RANGE_EDGES points on random edges are tried. RANGE_DRAWN points lie
#: on faces and inside, with more than seven parameters only inside. RANGE_STARTS compass searches follow. For up to
#: five parameters this takes the 500 sweeps of RANGES.
RANGE_EDGES, RANGE_ALONG, RANGE_DRAWN, RANGE_STARTS = 240, (3, 9), 48, 4

# Steps of iterations that converge. Brackets hold the largest number that was measured in the optimal and the default
# designs of cases I and II (n0, n1) and of 16 further loops of benchmarks/loops (n2 to o09) ---------------------------

#: Steps to a point of a barrier's path (7), and steps of the primal-dual method (60 in two runs because of rounding).
CENTRING_STEPS, CONE_STEPS = 60, 60
#: Passes of the exact test of definiteness (2). One pass is enough for a condition number below 1e14, and each further
#: pass divides the condition number by 1e14. Doublings of a Riccati or Lyapunov equation (21), and Newton steps that
#: follow them (1).
DEFINITE_PASSES, DOUBLINGS, RICCATI_STEPS = 4, 60, 4
#: Blocks of 256 ticks of an impulse response that are summed. Only a time constant above 250,000 ticks needs all
#: blocks.
GAIN_CHUNKS = 20_000


def require_size(states: int) -> None:
    """Raise TooLong for a proof over more than PROOF_STATES states."""
    if states > PROOF_STATES:
        raise TooLong(f"a proof over {states} states takes long: up to {PROOF_STATES} are tried")


_POINTS_SWEPT = 3000  # approximate number of points in a grid and its refinement
_RESPONSE, _SCHUR = 0.4e-9, 3e-9  # [s] measured time of a response per inputs x states^2, of a Schur form per states^3


def too_long(G: Lti, sweeps: int = 1) -> str | None:
    """Return the reason why this many sweeps of G, or of a system of its size, are refused, or None.

    Delays at the outputs of G cost no time.
    """
    n, m = G.inner_order, G.inputs
    seconds = sweeps * (_POINTS_SWEPT * m * (n**2 + m**2) * _RESPONSE + n**3 * _SCHUR)
    if seconds <= SWEEPS:
        return None
    how = f"some {sweeps} sweeps" if sweeps > 1 else "a sweep"
    too_slow = f"{how} over {n} states and {m} channels would take about {seconds:.0f} s, allowed are {SWEEPS:g} s"
    return f"{too_slow}: use a smaller psi, or fewer channels or masses"


def sweeping() -> AbstractContextManager[None]:
    """Return a context with the budget of a search by sweeps; TooLong is raised in it when the budget is spent."""
    return within(SWEEPS, "a search by sweeps", "many states or channels")
