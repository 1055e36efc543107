"""Shared heads: Motions with friction in space, event by event: closed forms and time stepping."""

import jimpact as ji

BRICK = ji.Box([0.1, 0.06, 0.04], mass=0.5)
SYSTEM, LAW = ji.System(BRICK, gravity=True), ji.Moreau(0.3, friction=0.4)


def thrown(q0, v0, duration, **options):
    return ji.simulate(SYSTEM, LAW, q0, v0, duration, samples=21, **options)
