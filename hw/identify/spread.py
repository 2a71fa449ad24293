"""How far the estimates of hw.identify.fit scatter: by what the residuals show, and by records that might have been.

Residuals show noise and what the model has not (the sandwich (J'J)^-1 J' R J (J'J)^-1 with Bartlett weights, Newey and
West 1987). They do not show where between two counts the encoder stood: in one record its error is one number over a
whole standstill, and no average over that record tells how it scatters. So records are made from the fitted model, with
parameters within their uncertainty, the encoder's origin anywhere within a step, the same rounding, and white noise as
strong as the residual's; each is estimated again by one Gauss-Newton step (parametric bootstrap; Efron and Tibshirani
1993, section 6.5). Both variances are added: rounding is then counted twice, which errs on the safe side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from hw.identify.axis_model import COULOMB, Model
from hw.identify.standstill import worth

BANDWIDTH = 60  # [ticks] over which residuals may be correlated
RECORDS = 40  # that might have been
ROUNDING = 1 / 12  # variance of an error that is uniform within a step
WIDEST = 0.2  # standard deviations of the parameters' logarithms beyond which they are not drawn


@dataclass(frozen=True, eq=False)
class Spread:
    """Of the parameters p of hw.identify.axis_model."""

    covariance: Array  # (p, p)
    bias: Array  # (p,) that the records that might have been have on average


def spread(model: Model, p: Array, seed: int = 0) -> Spread:
    """Of the estimate p (p,) from `model`'s record."""
    J = model.jacobian(p)
    residual = model.error(p)
    covariance = _sandwich(J, residual, model.weight)
    share = model.weight / model.weight.sum()
    noise = np.sqrt(max(0.0, float(share @ residual**2) / model.step**2 - ROUNDING))  # [counts]
    generator = np.random.default_rng(seed)
    root = _root(covariance)
    misses = np.array([_miss(model, p, root, J, noise, generator) for _ in range(RECORDS)])
    return Spread(covariance + np.cov(misses.T), misses.mean(axis=0))


def _miss(model: Model, p: Array, root: Array, J: Array, noise: float, generator: np.random.Generator) -> Array:
    """By how much a record that might have been is estimated wrong (p,)."""
    other = p + np.clip(root @ generator.standard_normal(p.size), -WIDEST, WIDEST)
    other[COULOMB] = max(0.0, other[COULOMB])
    exact = model.simulate(other)[model.used] / model.step + generator.uniform()
    counts = np.round(exact + noise * generator.standard_normal(exact.size))
    weight = worth(counts)
    error = model.step * (counts - exact)
    root_weight = np.sqrt(weight)
    centred = root_weight[:, None] * (J - np.average(J, axis=0, weights=weight))
    return np.linalg.pinv(centred) @ (root_weight * (error - np.average(error, weights=weight)))


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _sandwich(J: Array, residual: Array, weight: Array) -> Array:
    centred = J - np.average(J, axis=0, weights=weight)
    scores = centred * (weight * residual)[:, None]
    middle = scores.T @ scores
    for lag in range(1, min(BANDWIDTH, len(scores) - 1)):
        shared = scores[lag:].T @ scores[:-lag]
        middle += (1 - lag / BANDWIDTH) * (shared + shared.T)
    bread = np.linalg.pinv(centred.T @ (weight[:, None] * centred))
    return bread @ middle @ bread
