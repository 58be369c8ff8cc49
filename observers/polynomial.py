"""Monomials of several variables, up to a degree."""

import functools
import itertools
import math

import numpy as np


def count(variables: int, degree: int) -> int:
    """How many monomials there are, 1 among them."""
    return math.comb(variables + degree, degree)


def degree_of(terms: int, variables: int) -> int | None:
    """The degree up to which there are so many monomials; None where there is none."""
    if variables < 1:
        return None
    degree = next(degree for degree in itertools.count() if count(variables, degree) >= terms)
    return degree if count(variables, degree) == terms else None


@functools.cache
def table(variables: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """What monomials are made of, in the order of their degrees. Shapes: returns ``earlier, by`` (terms,)."""
    earlier, by, newest = [0], [0], [0]
    for _ in range(degree):
        made = [(t, j) for t in newest for j in range(by[t], variables)]  # each once: by variables that do not fall
        newest = list(range(len(earlier), len(earlier) + len(made)))
        earlier += [t for t, _ in made]
        by += [j for _, j in made]
    found = np.array(earlier), np.array(by)
    for each in found:
        each.flags.writeable = False  # it is everybody's
    return found


def monomials(q: np.ndarray, degree: int) -> np.ndarray:
    """Evaluate them, of degree 1 at least. Shapes: ``q`` (..., variables); returns (..., terms)."""
    variables = q.shape[-1]
    terms = np.empty((*q.shape[:-1], count(variables, degree)))
    terms[..., 0], terms[..., 1 : 1 + variables] = 1.0, q
    for new, earlier, by in products(variables, degree):
        np.multiply(terms.take(earlier, -1), q.take(by, -1), out=terms[..., new])
    return terms


@functools.cache
def products(variables: int, degree: int) -> list[tuple[slice, np.ndarray, np.ndarray]]:
    """Where the monomials of each degree from 2 on lie, and what they are made of."""
    earlier, by = table(variables, degree)
    ends = [count(variables, k) for k in range(1, degree + 1)]
    return [(slice(*span), earlier[slice(*span)], by[slice(*span)]) for span in itertools.pairwise(ends)]


__all__ = ["count", "degree_of", "monomials", "products", "table"]
