"""An observer's step outside NumPy, without known starts and monitor: as a module of Torch, as ONNX, and as C99."""

from training.export.exported import Exported

__all__ = ["Exported"]
