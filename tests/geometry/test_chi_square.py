"""Quantiles and tails of the chi-square distribution against SciPy's own, to the last bit."""

import numpy as np
import pytest
from scipy.stats import chi2

from gsmap.geometry.chi_square import chi2_log_survival, chi2_quantile

DOFS = np.array([1, 2, 3, 6, 7, 12, 40, 301])[:, None]


def test_quantiles_are_those_of_scipy() -> None:
    p = np.concatenate([[0.0, 0.5, 0.95, 0.9973, 0.999, 1.0], np.random.default_rng(0).uniform(size=2000)])
    assert np.array_equal(chi2_quantile(p, DOFS), chi2.ppf(p, DOFS))
    assert chi2_quantile(0.95, 1) == pytest.approx(3.841458820694124, rel=1e-12)  # printed tables: 3.841


def test_log_survival_is_that_of_scipy_in_both_tails() -> None:
    x = np.concatenate([[0.0, 1e-9, 1e9], np.random.default_rng(1).exponential(30.0, 2000)])
    assert np.array_equal(chi2_log_survival(x, DOFS), chi2.logsf(x, DOFS))
    assert chi2_log_survival(9.0, 2) == pytest.approx(-4.5, rel=1e-12)  # of two degrees of freedom it is exp(-x / 2)
