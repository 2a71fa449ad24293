"""Constant delays, one whole number of samples per channel: Theta (4), Psi (5) and Lambda (7)."""

from collections.abc import Sequence

import numpy as np

from controller.lti import Lti


def delay(steps: Sequence[int], T: float) -> Lti:
    """blockdiag(z^-n_1, ..., z^-n_m): a chain of n_i unit delays per channel."""
    return Lti.diag(*(_chain(n, T) for n in steps))


def _chain(n: int, T: float) -> Lti:
    if n != int(n) or n < 0:
        raise ValueError(f"a delay is a whole number of samples, zero or more, got {n}")
    if n == 0:
        return Lti.constant([[1.0]], T)
    first, last = np.zeros((n, 1)), np.zeros((1, n))
    first[0, 0] = last[0, -1] = 1.0
    return Lti(np.eye(n, k=-1), first, last, [[0.0]], T)
