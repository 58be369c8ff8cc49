"""Learned KKL observers. Running one needs only NumPy and safetensors; Numba, if installed, compiles its steps."""

from observers.artifact import Artifact
from observers.checks import ArtifactError
from observers.expression import Expression
from observers.factors import ErrorCovariance, Factors
from observers.filter import LinearFilter
from observers.inverse import ForwardMap, InverseMap
from observers.monitor import Limits, Monitor
from observers.motion import Equations, Flow, Motion
from observers.names import load, shipped
from observers.network import MLP
from observers.observer import KKLObserver

__all__ = [
    "MLP",
    "Artifact",
    "ArtifactError",
    "Equations",
    "ErrorCovariance",
    "Expression",
    "Factors",
    "Flow",
    "ForwardMap",
    "InverseMap",
    "KKLObserver",
    "Limits",
    "LinearFilter",
    "Monitor",
    "Motion",
    "load",
    "shipped",
]
