"""Numerical methods: derivatives, steps, complementarity, friction, linear systems.

Shapes stand in the signatures, `Float[Array, "m B"]`, with these names of axes:

    m      contacts
    t      tangential rows: m in the plane, 2 m in space, contact by contact
    rows   tangents of one contact: 1 in the plane, 2 in space;
           b = 1 + rows with its normal
    n      unknowns of a system, rows of a state; contacts with their tangents,
           n = m + t
    c, w   right sides; columns of a table
    k      margins, whose zeros are events
    modes  rows of whole numbers that events change
    driving  rows of a state that its rates depend on; the others only add up
    B      lanes of a batch, in the last axis; N the same in `friction.py`, for modes
           tried at once
    D, d   directions of differentiation: all, and those of one run
    K      neighbours of a contact

`1` is one row for all contacts; `...` and `*B` are any number of axes, also none; `#`
allows an axis of length 1 in the place of a longer one. `tests/rules/test_shapes.py`
checks them.
"""
