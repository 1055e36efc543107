"""Measured data that come with the package; README.md here says where each is from.

>>> import jimpact as ji
>>> len(ji.data.square_impacts().pre)
265
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
