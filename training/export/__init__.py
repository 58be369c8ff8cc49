"""An observer's step for programs without Python: as an ONNX graph, and as C99.

Both are of :class:`Exported`, and hold what :meth:`observers.KKLObserver.reset` and :meth:`observers.KKLObserver.step`
do with samples that are all there. What fills gaps and the monitor are left out.
"""

from training.export.exported import PRECISIONS, Exported

__all__ = ["PRECISIONS", "Exported"]
