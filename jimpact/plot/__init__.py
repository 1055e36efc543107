"""Pictures: one function for each kind of result; each returns a matplotlib figure.

Each room draws its own results, in its `pictures.py`; here are what all pictures share
and the face `ji.plot`, which finds them by the stub and imports a room's pictures when
one is asked for.

>>> import jimpact as ji
>>> result = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
>>> len(ji.plot.comparison(result).axes)
2
"""

from jimpact.tools.checks import needed
from jimpact.tools.faces import face

needed("matplotlib", "pip install matplotlib")  # the first of what all pictures import
__getattr__, __dir__ = face(__name__, __file__)
__all__ = __dir__()
