"""The differential harness of decisions: one by one, and all of them in one batch."""

from __future__ import annotations

import numpy as np

from shields import SafetyFilter
from shields.runtime.safety_filter import Decision


def decided_alike(
    shield: SafetyFilter,
    estimates: np.ndarray,
    shapes: np.ndarray,
    proposals: np.ndarray,
    stored: np.ndarray | None = None,
    least: float = 1.0,
) -> Decision:
    """The decisions of a batch, once those taken one by one were found to be the same.

    Args:
        shield: Decides.
        estimates: Shape (N, n).
        shapes: Of errors, shape (N, n, n).
        proposals: Shape (N, m).
        stored: Plans of the last decisions, shape (N, horizon, m), NaN behind their ends.
        least: In which share of the decisions the inputs are equal bit for bit; float64 may round otherwise in a
            batch, which float32 hardly ever shows.
    """
    many = shield.decide_many(estimates, shapes, proposals, stored)
    plans = [()] * len(estimates) if stored is None else [plan[~np.isnan(plan[:, 0])] for plan in stored]
    ones = [shield.decide(*each) for each in zip(estimates, shapes, proposals, plans, strict=True)]
    assert {type(value) for value in ones[0]} == {np.ndarray, bool, float, str}
    for name in ("reason", "intervened", "proved", "fallback", "stored"):
        np.testing.assert_array_equal(getattr(many, name), [getattr(one, name) for one in ones], name)
    applied, margins = np.array([one.input for one in ones]), np.array([one.margin for one in ones])
    np.testing.assert_allclose(many.input, applied, rtol=2.0**-23)
    same = (many.input == applied).all(axis=1)
    assert same.mean() >= least
    np.testing.assert_allclose(many.margin[same], margins[same], rtol=1e-12, atol=1e-12)
    lengths = np.count_nonzero(~np.isnan(many.plan[:, :, 0]), axis=1)
    np.testing.assert_array_equal(lengths, [len(one.plan) for one in ones])
    return many
