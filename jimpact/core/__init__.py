"""The core: scenes, contact space, the base class of laws, an impact and its checks.

`__init__.pyi` states what rooms above may take from it; docs/own_room.md builds one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
