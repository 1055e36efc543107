# /// script
# dependencies = ["pymunk==7.3.1"]
# ///
"""pymunk (Chipmunk): `Shape.elasticity`; a pair has the product of both. No threshold of speed."""

import pymunk
from rows import RADIUS, TIME, print_rows, root_of_product


def after(masses, wall, restitution, step):
    space, bodies = pymunk.Space(), []
    for k, mass in enumerate(masses):
        body = pymunk.Body(mass, pymunk.moment_for_circle(mass, 0, RADIUS))
        body.position = 2 * RADIUS * k, 0.0
        space.add(body, pymunk.Circle(body, RADIUS))
        bodies.append(body)
    if wall:
        x = RADIUS * (2 * len(masses) - 1)
        space.add(pymunk.Segment(space.static_body, (x, -1.0), (x, 1.0), 0.0))
    for shape in space.shapes:
        shape.elasticity, shape.friction = root_of_product(restitution), 0.0
    bodies[0].velocity = 1.0, 0.0
    for _ in range(round(TIME / step)):
        space.step(step)
    return [body.velocity.x for body in bodies]


if __name__ == "__main__":
    print_rows("pymunk", pymunk.version, {"step 1/60 s": {"step": 1 / 60}}, after)
