"""Event-aligned integration of impact dynamics.

Shapes stand in the signatures, `Float[Array, "m B"]`, with these names of axes:

    m      contacts
    t      tangential rows: m in the plane, 2 m in space, contact by contact
    n      rows of a state; in `implicit_steps.py` velocities and impulses, n = m + t
    k      margins, whose zeros are events
    modes  rows of whole numbers that events change: phases, closings, slip
    driving  rows of a state that its rates depend on; the others only add up
    B      impacts of a batch, in the last axis
    K      neighbours of a contact
    s      samples of a history, in the first axis

`1` is one row for all contacts; `...` and `*B` are any number of axes, also none; `#`
allows an axis of length 1 in the place of a longer one. `tests/rules/test_shapes.py`
checks them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
