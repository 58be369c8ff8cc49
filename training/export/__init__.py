"""An observer's step for programs without Python: as an ONNX graph, as C99, and for JavaScript.

All are of :class:`Exported`, and hold what :meth:`observers.KKLObserver.reset` and :meth:`observers.KKLObserver.step`
do with samples that are all there. What fills gaps, the monitor and error bars are in JavaScript alone. Observers that
track are exported as C99 alone, which fills their gaps.
"""

from training.export.exported import PRECISIONS, Exported

__all__ = ["PRECISIONS", "Exported"]
