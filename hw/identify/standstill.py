"""How much a sample of an encoder is worth to a fit: all samples of one standstill together as much as a few.

An encoder that stands still tells its position to half a step, however often it is read: the error of every sample is
the same one. Least squares that takes a thousand such samples for a thousand measurements moves the last place of a
release to the middle of its count, at the price of friction: Coulomb and viscous are exchanged until it fits.
"""

from __future__ import annotations

import numpy as np

from controller.lti import Array

APART = 1  # [counts] that noise may move an encoder at rest: it reads two neighbours in turn
WORTH = 5.0  # samples that one standstill counts as


def worth(counts: Array) -> Array:
    """Weights (N,) in (0, 1] of samples (N,) [counts]: 1 while the encoder moves, WORTH/L in a standstill of L samples.

    A standstill is a stretch, as long as possible from left to right, in which the counts differ by APART at most.
    """
    starts, low, high = [0], counts[0], counts[0]
    for k, n in enumerate(counts.tolist()):
        low, high = min(low, n), max(high, n)
        if high - low > APART:
            starts.append(k)
            low = high = n
    lengths = np.diff([*starts, len(counts)])
    return np.repeat(np.minimum(1.0, WORTH / lengths), lengths)
