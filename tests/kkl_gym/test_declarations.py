"""Class variables of a user's system: valid values, and messages for mistakes."""

import math
import re
from dataclasses import dataclass

import numpy as np
import pytest

from kkl_gym import System, VanDerPol

GOOD = {"name": "tank", "X": ((-1, 1), (-1, 1)), "bounds": ((-2, 2), (-2, 2)), "u_max": (1.0,), "G": ((0.0,), (1.0,))}
LEFT_OUT = object()


def declared(**changes):
    return type("Tank", (System,), {key: value for key, value in {**GOOD, **changes}.items() if value is not LEFT_OUT})


def test_defaults_follow_from_the_box():
    cls = declared(X=((-1, 3), (-2, 2)), bounds=((-9, 9), (-9, 9)), scale=(), X_centre=())
    assert cls.state_names == ("x1", "x2")
    assert cls.scale == (2.0, 2.0)
    assert cls.X_centre == (1.0, 0.0)


def test_a_parameter_that_a_subclass_does_not_redeclare_is_refused():
    with pytest.raises(TypeError, match=r"Softer: mu = 1\.0 does not change the parameter mu: write mu: float = 1\.0"):

        class Softer(VanDerPol):
            name = "softer"
            mu = 1.0

    class Annotated(VanDerPol):
        name = "annotated"
        mu: float = 1.0

    with pytest.raises(TypeError, match="Annotated has a parameter mu, but lacks @dataclass"):
        Annotated()
    assert dataclass(frozen=True)(Annotated)().mu == 1.0


def test_attributes_that_would_be_lost_are_refused_in_parents_too():
    with pytest.raises(TypeError, match="Tank defines __init__, and a copy would lack what __init__ sets"):
        declared(__init__=lambda self: None)
    hardware = type("Hardware", (), {"__init__": lambda self: None})
    with pytest.raises(TypeError, match="Boat defines __init__, and a copy would lack"):
        type("Boat", (hardware, VanDerPol), {"name": "boat"})
    with pytest.raises(TypeError, match=r"Mixed: mu = 2\.0 does not change the parameter mu"):
        type("Mixed", (type("Softer", (), {"mu": 2.0}), VanDerPol), {"name": "mixed"})


def test_lists_arrays_and_numbers_of_numpy_become_tuples_of_numbers():
    cls = declared(
        X=np.array([[-1, 1], [-1.5, 1]]), u_max=np.array([3]), G=np.array([[0], [1]]), scale=[1, np.float64(2)]
    )
    assert repr((cls.X, cls.u_max, cls.G, cls.scale)) == (
        "(((-1.0, 1.0), (-1.5, 1.0)), (3.0,), ((0.0,), (1.0,)), (1, 2.0))"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": LEFT_OUT}, "Tank must set the class variables name, X and bounds; it lacks name"),
        ({"name": "a/b"}, "name = 'a/b' must be a non-empty text without slash"),
        ({"X": ((math.nan, 1), (-1, 1))}, "X = ((nan, 1), (-1, 1)) must be (low, high) for each state"),
        ({"X": property(lambda self: ((-1, 1), (-1, 1)))}, "must be (low, high) for each state, as in"),
        ({"X": ((-1, 1), (1, 1))}, "X[1] = (1, 1) must be (low, high) with low < high"),
        ({"X": ((-1, 1), (-3, 1))}, "X[1] = (-3, 1) must be within bounds[1] = (-2, 2)"),
        ({"bounds": ((-2, 2),)}, "Tank: X has 2 states and bounds has 1"),
        ({"u_max": (0.0,)}, "u_max = (0.0,) must be a tuple of positive numbers"),
        ({"u_max": LEFT_OUT}, "Tank: G = ((0.0,), (1.0,)) needs u_max, the bound of each input; without it"),
        ({"scale": (1.0, 0.0)}, "scale = (1.0, 0.0) must be 2 positive numbers"),
        ({"G": ((0.0,), (1.0, 2.0))}, "G = ((0.0,), (1.0, 2.0)) must be 2 rows of 1 numbers"),
        ({"portrait": (0, 2)}, "portrait = (0, 2) must be two indices of its 2 states, as in (0, 1)"),
        ({"state_names": ("angle",)}, "state_names = ('angle',) must be a tuple of 2 texts"),
        ({"process_noise": -0.1}, "process_noise = -0.1 must be a number, not below zero"),
        ({"dt": 0}, "dt = 0 must be a positive number of seconds"),
        ({"step": lambda self, x, u: x}, "Tank defines step and must set dt, the sampling interval in seconds"),
        ({"g": 9.81}, "g = 9.81 must be a method; a parameter g needs another name"),
        ({"nx": 2}, "nx = 2 follows from X: leave it out"),
    ],
    ids=lambda value: ", ".join(value) if isinstance(value, dict) else "",
)
def test_mistakes_in_class_variables_are_named(changes, message):
    with pytest.raises(TypeError, match=re.escape(message)) as raised:
        declared(**changes)
    assert str(raised.value).startswith("Tank")


@pytest.mark.parametrize(("name", "value"), [("X", ((-1, 1),)), ("dt", 0.1), ("pace", 1.0), ("g", 9.81)])
def test_a_class_variable_that_is_annotated_as_a_parameter_is_named(name, value):
    variables = {"name": "tank", "X": ((-1, 1),), "bounds": ((-2, 2),), name: value, "__annotations__": {name: tuple}}
    with pytest.raises(TypeError, match=rf"Tank: {name} is annotated as a parameter, .* write {name}: ClassVar = "):
        type("Tank", (System,), variables)


def test_another_system_needs_a_name():
    with pytest.raises(TypeError, match="Wide differs from the system 'van_der_pol' and needs a name of its own"):
        type("Wide", (VanDerPol,), {"X": ((-9, 9), (-9, 9))})
