"""Evaluate conditions for a transfer matrix and data of a loop, and read the reports of commands.

F is the force map, G the map before the delays Theta, V the coupling; lo and hi are the ends of switching delays
[samples].
"""

from __future__ import annotations

import json

from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.design import conditions, environments
from haptic_loop.design.certificate import prove


def loop(T, delta, theta=None, walls=(), psi=None, environment=None, **further) -> Loop:
    """Return a loop, by default with a spring at each contact; `walls` are stiffnesses [N/m] at the first contact."""
    m = len(delta)
    contacts = tuple(f"contact {i}" for i in range(m))
    springs = tuple(Spring((contact, GROUND), 1.0) for contact in contacts)
    network = environment or Network(contacts, springs, walls=tuple(Wall((contacts[0], GROUND), k) for k in walls))
    none = (0,) * m
    theta, psi = (none if n is None else tuple(n) for n in (theta, psi))
    return Loop(float(T), theta, psi, none, tuple(delta), network, **further)


def this_environment_demand(F, delta, T_max=None, latency=None):
    return conditions.this_environment_demand(F, loop(F.T, delta, T_max=T_max, latency=latency))


def latency_demand(F, delta, latency, T_max=None):
    return this_environment_demand(F, delta, T_max, latency)


def this_environment(F, delta, T_max=None, latency=None):
    return conditions.this_environment(F, loop(F.T, delta, T_max=T_max, latency=latency))


def any_environment_demand(V, theta, delta, T_max=None, phi=None):
    return conditions.any_environment_demand(V, loop(V.T, delta, theta, T_max=T_max), phi)


def any_environment(V, theta, delta, T_max=None):
    return conditions.any_environment(V, loop(V.T, delta, theta, T_max=T_max))


def any_environment_per_channel(V, theta, delta):
    return conditions.any_environment_per_channel(V, loop(V[0].T, delta, theta))


def walls_demand(G, delta, stiffness, a):
    """Return the demand of w walls without dampers for the multiplier a (w,) [N/m]; G includes all delays."""
    none = (0,) * (3 * len(stiffness))
    return environments.THIS_ENVIRONMENT.block(G, loop(G.T, delta, walls=stiffness), (*a, *none))


def _switching(G, lo, hi, delta, T_max=None):
    return loop(G.T, delta, lo, T_max=T_max, varying_delay=DelayRange(tuple(lo), tuple(hi)))


def switching_demand(G, lo, hi, delta, alpha, T_max=None):
    return environments.SWITCHING.block(G, _switching(G, lo, hi, delta, T_max), alpha)


def switching_sweep(G, lo, hi, delta, alpha=None, T_max=None):
    return environments.SWITCHING.required_of(G, _switching(G, lo, hi, delta, T_max), alpha)


def prove_limiter(loop, coupling, beta=environments.BETA, c=None, swept=None):
    """Return a certificate of limited forces for the multiplier c (m, lags), or for the best one."""
    condition = environments.LimitedForces(beta, len(c[0]) if c else 1)
    return prove(loop, coupling, condition, [v for row in c for v in row] if c else None, swept)


def _lagging(rho, lags):
    """Return the condition of a limiter with this rho [N/m] and `lags` weights c per device."""
    return environments.LimitedForces(lags=lags, held=tuple(float(r) for r in rho))


def limiter_demand(G, theta, delta, rho, c, T_max=None):
    flat = [v for row in c for v in row]
    return _lagging(rho, len(c[0])).block(G, loop(G.T, delta, theta, T_max=T_max), flat)


def limiter(G, theta, delta, rho, c=None, lags=1, T_max=None):
    flat = None if c is None else [v for row in c for v in row]
    return _lagging(rho, len(c[0]) if c else lags).required_of(G, loop(G.T, delta, theta, T_max=T_max), flat)


def summed(demand):
    """Return the block of a demand, which must be positive real: its free part and that of the damping."""
    return demand.free + demand.gain


def reported(main, folder, *options):
    """Run a command, and return its exit code and the report that it writes into the folder."""
    code = main([*options, "--json", str(folder / "r.json")])
    return code, json.loads((folder / "r.json").read_text())


def decisive(report):
    """Return the requirement of the condition that decides the verdict, from a command's JSON."""
    assessment = report["assessment"]
    return assessment["requirements"][assessment["condition"]]


def needs(report, condition):
    """Return the requirement of a condition, from a command's JSON."""
    return report["assessment"]["requirements"][condition]


def safe_with(report):
    """Return the environments of the guarantee, from a command's JSON, or None if there is no guarantee."""
    guarantee = report["assessment"]["guarantee"]
    return guarantee and guarantee["environments"]
