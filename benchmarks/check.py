"""Compare another tool with the published figures: python benchmarks/check.py [YOURS.py]

YOURS.py defines functions named like columns of figures.csv, such as `reference_this_environment(loop)`. `loop` is a
TOML file as a dictionary; the result is a number, or None if the tool has no answer. Without YOURS.py the two reference
functions below are compared. They need only NumPy, sweep frequencies, and share no code with the program that writes
the table.
"""

import csv
import runpy
import sys
import tomllib
from pathlib import Path

import numpy as np

HERE, BEYOND = Path(__file__).parent, {"latency", "varying_delay", "T_max"}  # keys that no function below covers
Z = np.exp(1j * np.geomspace(1e-4, np.pi, 40_000))


def object_(loop):
    """Return E (n, m, m) [N/m] at the n points Z: the network by backward Euler, with its inner nodes eliminated."""
    env, rate = loop["environment"], (1 - 1 / Z) / loop["T"]
    nodes, m = [*env["contacts"], *env.get("masses", {})], len(env["contacts"])
    Y = np.zeros((Z.size, len(nodes), len(nodes)), complex)
    for i, mass in enumerate(env.get("masses", {}).values(), start=m):
        Y[:, i, i] += mass * rate**2
    for spring in env["springs"]:
        side = np.array([float(node == spring["between"][0]) - float(node == spring["between"][1]) for node in nodes])
        Y += (spring["stiffness"] + spring.get("damping", 0.0) * rate)[:, None, None] * np.outer(side, side)
    return Y[:, :m, :m] - Y[:, :m, m:] @ np.linalg.solve(Y[:, m:, m:], Y[:, m:, :m])


def reference_this_environment(loop):
    """Return the largest eigenvalue of -T He[F/(z - 1)] relative to Delta, with F = Theta (I + Psi E V)^-1 Psi E."""
    if BEYOND & set(loop) or loop["environment"].get("walls"):
        return None
    delta, T = np.array([device["damping"] for device in loop["device"]]), loop["T"]
    V = 1 / (delta / (2 * T) + delta / 4 * ((1 - 1 / Z) / T)[:, None])  # the reference coupling of README.md
    late = lambda steps: Z[:, None, None] ** -np.array(steps, float)[:, None]  # noqa: E731
    E = late(loop.get("psi", [0] * len(delta))) * object_(loop)
    F = late(loop["theta"]) * np.linalg.solve(np.eye(len(delta)) + E * V[:, None, :], E)
    H = -T * F / (Z - 1)[:, None, None] / np.sqrt(np.outer(delta, delta))
    return np.linalg.eigvalsh((H + H.conj().transpose(0, 2, 1)) / 2).max()


def reference_any_environment(loop):
    """Return the largest T (1 - cos (theta + 1) w)/(2 delta Re[(1 - 1/z) V]) of all channels; None unless psi = 0."""
    if BEYOND & set(loop) or any(loop.get("psi", [])):
        return None
    w = np.angle(Z)
    # the reference coupling's compliance V of each channel, divided by T/delta
    V = [1 / (1 / 2 + (1 - 1 / Z) / 4) for _ in loop["theta"]]
    shares = [(1 - np.cos((n + 1) * w)) / (2 * ((1 - 1 / Z) * v).real) for n, v in zip(loop["theta"], V, strict=True)]
    return max(map(np.max, shares))


if __name__ == "__main__":
    yours = runpy.run_path(sys.argv[1]) if len(sys.argv) > 1 else globals()
    for row in csv.DictReader((HERE / "figures.csv").open()):
        loop = tomllib.loads((HERE / "loops" / f"{row['loop']}.toml").read_text())
        for name in [name for name in row if callable(yours.get(name)) and row[name]]:
            if (computed := yours[name](loop)) is not None:
                published = float(row[name])
                print(f"{row['loop']:26} {name:28} {published:10.5g} {computed:10.5g} {computed / published - 1:+.1e}")
