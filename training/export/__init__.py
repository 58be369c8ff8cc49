"""An observer's step for programs without Python: as an ONNX graph, as C99, and for JavaScript.

All are of :class:`Exported`, and hold what :meth:`observers.KKLObserver.reset` and :meth:`observers.KKLObserver.step`
do with samples that are all there. What fills gaps is in JavaScript and, of observers that track, everywhere. The
monitor and calibrated covariances are in JavaScript alone.
"""

from training.export.exported import PRECISIONS, Exported

__all__ = ["PRECISIONS", "Exported"]
