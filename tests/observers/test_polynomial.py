"""Monomials, and the flows that are made of them."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from random_tracking import a_flow

from observers.polynomial import count, degree_of, monomials


@pytest.mark.parametrize(("variables", "degree"), [(1, 4), (3, 5), (7, 2)])
def test_monomials_are_all_products_once(variables, degree):
    q = np.random.default_rng(0).normal(size=(6, 2, variables))
    chosen = [each for k in range(degree + 1) for each in itertools.combinations_with_replacement(range(variables), k)]
    expected = np.stack([np.prod(q[..., list(each)], axis=-1) for each in chosen], axis=-1)
    np.testing.assert_allclose(monomials(q, degree), expected, rtol=1e-13)
    assert count(variables, degree) == len(chosen)
    assert degree_of(len(chosen), variables) == degree


def test_what_is_no_number_of_monomials_has_no_degree():
    found = [degree_of(terms, 3) for terms in range(12)]
    assert found == [None, 0, None, None, 1, *[None] * 5, 2, None]
    assert degree_of(0, 0) is degree_of(5, 0) is None


def test_a_flow_of_a_higher_degree_goes_on_with_one_of_a_lower():
    """Terms of a higher degree come behind: with zeros there it is the same flow."""
    flow = a_flow(2, 1, 1)
    linear = replace(flow, polynomial=flow.polynomial[:, :4])
    padded = replace(flow, polynomial=np.pad(flow.polynomial[:, :4], [(0, 0), (0, 52)]))
    x, u = np.random.default_rng(1).normal(size=(5, 2)), np.random.default_rng(2).normal(size=(5, 1))
    assert (linear.degree, flow.degree, padded.degree) == (1, 3, 5)
    np.testing.assert_allclose(padded(x, u), linear(x, u), rtol=1e-14)
    assert np.abs(flow(x, u) - linear(x, u)).max() > 1e-5
