"""What `save` writes `load` reads, at the limits of both: polytopes of any size allowed, plants of any numbers."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shields import Certificate, CertificateError
from shields.polytope import MOST_MULTIPLIERS, MOST_ROWS, Polytope


def with_polytope(certificate, rows, multipliers, seed=0):
    """A certificate, not a valid one, with a polytope of so many rows and rows of multipliers, most of them zero."""
    rng = np.random.default_rng(seed)
    values = np.zeros((multipliers, rows))
    values[rng.integers(multipliers, size=50), rng.integers(rows, size=50)] = rng.standard_normal(50)
    polytope = Polytope(rows=rng.standard_normal((rows, 2)), multipliers=values)
    proofs = [replace(each, shares=None, inputs=None) for each in certificate.proofs]
    return replace(certificate, safe_set=polytope, proofs=proofs, rounding=None)


@settings(max_examples=30, deadline=None)
@given(rows=st.integers(1, MOST_ROWS), multipliers=st.integers(1, 3 * MOST_ROWS), seed=st.integers(0, 9))
def test_document_of_any_polytope_is_read_again(certificate, rows, multipliers, seed):
    saved = with_polytope(certificate, rows, multipliers, seed)
    assert Certificate.read(saved.document) == saved


@pytest.mark.parametrize(("rows", "multipliers"), [(MOST_ROWS + 1, MOST_ROWS + 2), (1, MOST_MULTIPLIERS + 1)])
def test_polytope_that_could_not_be_read_again_cannot_be_made(rows, multipliers):
    with pytest.raises(CertificateError, match=f"at most {MOST_ROWS} rows and {MOST_MULTIPLIERS} rows of multipliers"):
        Polytope(rows=np.ones((rows, 1)), multipliers=np.zeros((multipliers, rows)))
