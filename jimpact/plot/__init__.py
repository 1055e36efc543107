"""Pictures: one function for each kind of result; each returns a matplotlib figure.

>>> import jimpact as ji
>>> result = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
>>> len(ji.plot.comparison(result).axes)
2
"""

import lazy_loader

from jimpact.tools.checks import needed

needed("matplotlib", "pip install matplotlib")  # the first of what all pictures import
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
