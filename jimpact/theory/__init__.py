"""Theory of impacts with several contacts: sets, audits of matrices, bounds.

>>> import jimpact as ji
>>> cradle = ji.chain([1.0, 1.0, 1.0])
>>> bool(ji.theory.audit_matrix(cradle, [[0.0, 0.8], [0.9, 0.0]]).admissible)
True
"""

from jimpact.tools.faces import face

# Two functions of the chapter need a `System`: the stub says that motions hold them.
__getattr__, __dir__ = face(__name__, __file__)
__all__ = __dir__()
