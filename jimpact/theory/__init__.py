"""Theory of impacts with several contacts: admissible sets, audits of matrices, bounds, rocking.

>>> import jimpact as ji
>>> cradle = ji.chain([1.0, 1.0, 1.0])
>>> bool(ji.theory.audit_matrix(cradle, [[0.0, 0.8], [0.9, 0.0]]).admissible)
True
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
