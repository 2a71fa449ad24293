"""Passive hands whose energy is known exactly, for tests of energy accounts."""

import numpy as np
from scipy.linalg import expm


class Hands:
    """Devices in random passive hands, integrated by the matrix exponential.

    `lossless` (only the devices dissipate) and `start` (scale of the initial velocities [m/s]) are scalars or (nsim,).
    `masses` is the number of masses; the first of them are the devices, with damping `delta` [N s/m].
    """

    def __init__(self, rng, nsim, lossless, start=0.0, masses=None, T=1.2e-3, delta=(1.37, 0.9)):
        m = self.m = len(delta)  # channels
        n = self.n = masses or m + 2
        root = rng.normal(size=(nsim, n, n))
        self.M = np.zeros((nsim, n, n))
        self.M[:, range(n), range(n)] = np.exp(rng.uniform(np.log(0.02), np.log(2.0), (nsim, n)))
        self.K = root @ root.transpose(0, 2, 1) * np.exp(rng.uniform(0, np.log(2000), (nsim, 1, 1)))
        loss = rng.normal(size=(nsim, n, n)) * np.reshape(np.logical_not(lossless), (-1, 1, 1))
        damping = loss @ loss.transpose(0, 2, 1)
        damping[:, range(m), range(m)] += delta
        inverse = np.linalg.inv(self.M)
        generator = np.zeros((nsim, 2 * n + m, 2 * n + m))
        generator[:, :n, n : 2 * n] = np.eye(n)
        generator[:, n : 2 * n, :n], generator[:, n : 2 * n, n : 2 * n] = -inverse @ self.K, -inverse @ damping
        generator[:, n : 2 * n, 2 * n :] = -inverse[:, :, :m]
        self.step = expm(generator * T)[:, : 2 * n]
        self.s = np.concatenate([np.zeros((nsim, n)), np.reshape(start, (-1, 1)) * rng.normal(size=(nsim, n))], axis=1)

    @property
    def x(self):
        return self.s[:, : self.m].T.copy()

    @property
    def v(self):
        return self.s[:, self.n : self.n + self.m].T

    def energy(self):
        """Return the stored energy (nsim,) [J]."""
        q, v = self.s[:, : self.n], self.s[:, self.n :]
        return (q[:, None] @ self.K @ q[:, :, None] + v[:, None] @ self.M @ v[:, :, None])[:, 0, 0] / 2

    def hold(self, f):
        """Advance by T under forces f (m, nsim) [N]; the devices feel -f."""
        self.s = (self.step @ np.concatenate([self.s, f.T], axis=1)[:, :, None])[:, :, 0]
