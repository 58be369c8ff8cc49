"""The methods of the benchmark, by name."""

from inspect import isabstract
from typing import Any

from examples.research.methods.ablation import (
    AdaptiveSPINN,
    BySOAP,
    LipschitzSPINN,
    MoreModes,
    MovingSPINN,
    NoiseAware,
    OwnFree,
    PapersSPINN,
    ScaledSPINN,
    SmoothSPINN,
    SolvedSPINN,
    SPINNBySOAP,
    SPINNOfAnyAge,
    Transients,
    Tuned,
)
from examples.research.methods.autoencoder import AE
from examples.research.methods.base import Budget, CausalObserver, Configuration, Data, Method, Task, WrongParameters
from examples.research.methods.dmf import DMF, DMFNoise
from examples.research.methods.gru import GRU
from examples.research.methods.kalman import EKF, UKF, Guided, UntunedEKF, WrongEKF
from examples.research.methods.kalmannet import KalmanNet
from examples.research.methods.kkl import SPINN, Default, Shipped, ShippedSPINN, ShippedStatic, WrongDefault, WrongSPINN
from examples.research.methods.node import NODE, NODENoise
from examples.research.methods.rkn import RKN
from kkl_gym.loading import load_class

METHODS: dict[str, type[Method[Any]]] = {
    cls.name: cls
    for cls in (
        Default,
        SPINN,
        AE,
        DMF,
        DMFNoise,
        NODE,
        NODENoise,
        GRU,
        KalmanNet,
        RKN,
        EKF,
        UKF,
        WrongEKF,
        WrongDefault,
        WrongSPINN,
        UntunedEKF,
    )
}
# Steps from the paper's pipeline to the package's and past it, which ``make ablation`` compares in this order.
ABLATION: dict[str, type[Method[Any]]] = {
    cls.name: cls
    for cls in (
        PapersSPINN,
        SPINNBySOAP,
        SmoothSPINN,
        MovingSPINN,
        ScaledSPINN,
        SolvedSPINN,
        SPINNOfAnyAge,
        AdaptiveSPINN,
        LipschitzSPINN,
        Transients,
        NoiseAware,
        MoreModes,
        BySOAP,
        OwnFree,
        Default,
        Tuned,
    )
}

# Those that need a map that ships for the system, and are in no table unless they are named.
AS_SHIPPED: dict[str, type[Method[Any]]] = {cls.name: cls for cls in (Shipped, ShippedSPINN, ShippedStatic, Guided)}


def get_method(name: str) -> Method[Any]:
    """Find a method of the benchmark."""
    shipped = METHODS | ABLATION | AS_SHIPPED
    if name in shipped:
        return shipped[name]()
    if ":" not in name:
        raise ValueError(
            f"unknown method {name!r}; there are {', '.join(shipped)}; your own: 'module:Class' or 'script.py:Class'"
        )
    found = load_class(name, Method)  # type: ignore[type-abstract]
    if isabstract(found):
        raise ValueError(f"the method {name!r} must define {', '.join(sorted(found.__abstractmethods__))}")
    if not isinstance(vars(found).get("name"), str) or not isinstance(getattr(found, "label", None), str):
        raise ValueError(f"the method {name!r} must set the class variables name and label, its own")
    if shipped.get(found.name, found) is not found:
        raise ValueError(f"the method {name!r} takes the name {found.name!r} of another; give it one of its own")
    return found()


__all__ = [
    "ABLATION",
    "AS_SHIPPED",
    "METHODS",
    "Budget",
    "CausalObserver",
    "Configuration",
    "Data",
    "Method",
    "Task",
    "WrongParameters",
    "get_method",
]
