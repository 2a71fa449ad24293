"""Budgets of the searches, in one table: how much each may try, and the measurement that set it.

No clock ends a search, so that a busy machine designs what an idle one does. A search ends because it has converged,
because a proof or a bound says so, or because one of these budgets is spent. Work is counted from the sizes of
matrices and numbers (`haptic_loop.controller.arithmetic.spend`); one unit takes about a second on one core.
Halvings down to rounding and the iterations of a tick are no searches: their numbers stand where they are used.
Measured on 23 loops, of which 22 are in benchmarks/loops, on one core of an AMD EPYC at 2.4 GHz.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

# Work that is counted [units] -----------------------------------------------------------------------------------------

#: Exact arithmetic for one coupling. A proof over 100 states takes 0.3, and the largest that is tried, 800, took 30.
EXACT = 60.0
#: A sweep, or a search by many of them. A sweep takes 0.006 for two devices and 0.008 for three.
SWEEPS = 60.0
#: Growing the basis of an optimal coupling. The longest of the 23 take 19 (o11), 17 (o08) and 15 (n6, n7).
GROWTH = 60.0
#: The search between the vertices of ranges, for one coupling: some 500 sweeps for each set of contacts.
RANGES = 60.0
#: The price of 10 %, by the most devices. It takes up to 2.2 (two devices), 6.6 (three, four) and 16.4 (more).
PRICE = {2: 6.0, 4: 12.0, 10**3: 40.0}

# Sizes and numbers of the bases of an optimal coupling ----------------------------------------------------------------

#: States of the loop, up to which a basis is tried: solving and proving one of 268 takes 8 for four devices (n6).
BASIS_STATES = 270
#: (environments) states^2.7 of the proofs of a basis, as many as 30 proofs over 112 states have.
BASIS_PROOFS = 30 * 112**2.7
#: Unknowns of a basis, where this-environment alone is asked: ten seconds.
BASIS_UNKNOWNS = 1600
#: Unknowns by channels, where more is asked: ten seconds, too.
BASIS_BESIDE = 3500
#: Bases without a proof, one after the other, after which the growth ends.
UNPROVED_BASES = 2
#: Bases, the best first, until one is proved at every vertex of ranges.
RANGED_BASES = 3

# Sizes of proofs, and rounds of searches that converge earlier: how many the measured ones took ----------------------

#: States of a block that is proved: .3 s at 100, 1 s at 200, 5 s at 400, 30 s at 800.
PROOF_STATES = 800
#: Rounds of cuts of a multiplier. one-wall takes 8. Rounds without a rise of its bound: rounding.
MULTIPLIER_ROUNDS, MULTIPLIER_STALLED = 40, 3
#: Rows of a block whose multiplier is searched: those of twelve devices with limited forces.
MULTIPLIER_ROWS = 24
#: Searches for gains with further frequencies, and steps of each: from every start of many devices, from the likeliest
#: of many, from each of few. Case I takes 3 searches.
GAIN_ROUNDS, GAIN_STEPS = 8, (15, 60, 100)
#: Rounds with further frequencies of Theorem 4. Only delays of a hundred samples and more take any.
THEOREM_4_ROUNDS = 12
#: Steps of the sequence of convex problems for gains. Case I takes 2.
SEQUENCE_STEPS = 60
#: Designs for less damping where a condition is judged that no design knows. one-wall takes 2.
LESS_DAMPING_ROUNDS = 6
#: Rounds with further frequencies of an optimal coupling. Case I takes 4.
PROGRAM_SWEEPS = 6
#: The same of the bound on linear couplings; sums of coefficients that it uses; intervals of its integral. Cases I
#: and II take 2 rounds and 568 intervals; a sum is a step of a delay in one row.
BOUND_SWEEPS, BOUND_SUMS, BOUND_INTERVALS = 6, 240, 20_000
#: Problems of a coupling of fixed order: in all, for one norm by complementarity, and cuts for one choice of poles.
#: Case I takes 32 in all by inner approximation; fixed poles (105) and complementarity (103, 20 for one norm) spend
#: them; a choice of poles takes 2 cuts.
FIXED_ORDER_PROBLEMS, COMPLEMENTARITY_PROBLEMS, FIXED_POLE_CUTS = 100, 20, 20
#: Cuts of the least share of a known device at one beta, and rounds of tangents for beta and multipliers. The pair of
#: omega.3 with known transmissions takes 4 and 11, one with walls and limited forces 20.
BETA_CUTS, BETA_ROUNDS = 40, 60
#: Points between the vertices of ranges: on all edges, least and most on one, on faces and inside, starts uphill.
#: These are the some 500 sweeps of RANGES.
RANGE_EDGES, RANGE_ALONG, RANGE_DRAWN, RANGE_STARTS = 240, (3, 9), 48, 4

# Steps of iterations that converge: in brackets the most that the optimal and the default designs of cases I and II
# and of 16 loops of benchmarks/loops (n0 to o09) took -----------------------------------------------------------------

#: Newton steps to the centre of a barrier (spent in 9 centrings, whose last points are kept), and of the primal-dual
#: method (spent twice, where rounding stops it).
CENTRING_STEPS, CONE_STEPS = 60, 60
#: Passes of the exact test of definiteness (2): one is enough for a condition number below 1e14, and each further one
#: takes as much off what is left. Doublings of a Riccati or Lyapunov equation (21), and Newton steps after them (1).
DEFINITE_PASSES, DOUBLINGS, RICCATI_STEPS = 4, 60, 4
#: Rounds of halving of an integral (3), and intervals that are halved in one round.
INTEGRAL_ROUNDS, INTEGRAL_INTERVALS = 20, 1000
#: Blocks of 256 ticks over which an impulse response is summed, up to 1e-9 of the sum; the bound counts the rest.
#: Only a mode that takes 250,000 ticks to fall to 1/e spends them.
GAIN_CHUNKS = 20_000

_Value = TypeVar("_Value")


def of_channels(table: Mapping[int, _Value], channels: int) -> _Value:
    """Return the entry of a table that is made by the most channels."""
    return next(value for most, value in table.items() if channels <= most)
