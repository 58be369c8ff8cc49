"""An observer's step outside NumPy: as a module of Torch, which exports to ONNX, and as C99.

Both hold what :meth:`observers.KKLObserver.reset` and :meth:`observers.KKLObserver.step` do, but for known starts and
the monitor. Gaps are filled in C only by observers that track.
"""

from training.export.exported import PRECISIONS, Exported

__all__ = ["PRECISIONS", "Exported"]
