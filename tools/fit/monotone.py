"""Additive models over log-odds whose curves only fall: what `tools.fit.find` and `tools.fit.shape` share."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize


def fit_curves(
    x: np.ndarray, right: np.ndarray, *, ridge: float, share: float = 0.5, num_knots: int = 7
) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """Knots and log-odds of a curve for each column, and the log-odds where all are 0, by logistic regression.

    Args:
        x: (N, F) differences or doubts: 0 where nothing speaks against.
        right: (N,) bool.
        ridge: on the slopes.
        share: of the weight that the right ones have.
    """
    knots = []
    for column in x.T:
        inner = np.quantile(column[right], np.linspace(0.2, 0.98, num_knots - 2))
        knots.append(np.unique(np.concatenate([[0.0], inner, [np.quantile(column[~right], 0.8)]]).round(4)))
    basis = np.concatenate([_steps(column, k) for column, k in zip(x.T, knots, strict=True)], axis=1)
    weight = np.where(right, share / right.sum(), (1 - share) / (~right).sum())
    sign = np.where(right, 1.0, -1.0)

    def loss(p: np.ndarray) -> tuple[float, np.ndarray]:
        odds = p[0] - basis @ p[1:]
        wrong = 1 / (1 + np.exp(np.clip(sign * odds, -50, 50)))
        slope = -weight * sign * wrong
        value = float(weight @ np.logaddexp(0, -sign * odds) + ridge * (p[1:] ** 2).sum())
        return value, np.append(slope.sum(), -(basis.T @ slope) + 2 * ridge * p[1:])

    start = np.zeros(1 + basis.shape[1])
    bounds = [(None, None)] + [(0.0, None)] * basis.shape[1]
    p = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 500}).x
    worth, at = [], 1
    for k in knots:
        worth.append(np.concatenate([[0.0], -np.cumsum(p[at : at + len(k) - 1])]))
        at += len(k) - 1
    return knots, worth, float(p[0])


def _steps(values: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(N, K - 1) how far each value has come through each interval of the knots, from 0 to 1."""
    if len(knots) < 2:
        return np.zeros((len(values), 0))
    return np.clip((values[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0)
