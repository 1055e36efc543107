# /// script
# dependencies = ["box2d==2.3.10"]
# ///
"""Box2D 2.3 (PyPI `box2d`): `restitution` of a fixture; a pair has the larger one.

`b2_velocityThreshold` is 1 m/s, below which nothing bounces, so that a setting is faster.
"""

from importlib.metadata import version

from Box2D import b2CircleShape, b2EdgeShape, b2FixtureDef, b2World
from rows import RADIUS, TIME, print_rows


def after(masses, wall, restitution, step, speed):
    world, bodies = b2World(gravity=(0, 0), doSleep=False), []
    for k, mass in enumerate(masses):
        density = mass / (3.141592653589793 * RADIUS**2)
        disc = b2FixtureDef(
            shape=b2CircleShape(radius=RADIUS),
            density=density,
            friction=0.0,
            restitution=restitution,
        )
        bodies.append(
            world.CreateDynamicBody(position=(2 * RADIUS * k, 0), fixtures=disc)
        )
    if wall:
        x = RADIUS * (2 * len(masses) - 1)
        edge = b2EdgeShape(vertices=[(x, -1), (x, 1)])
        world.CreateStaticBody(
            fixtures=b2FixtureDef(shape=edge, friction=0.0, restitution=restitution)
        )
    bodies[0].linearVelocity = (speed, 0)
    for _ in range(round(TIME / step)):
        world.Step(
            step, 8, 3
        )  # iterations of velocities and positions that its manual proposes
    return [body.linearVelocity.x for body in bodies]


if __name__ == "__main__":
    settings = {
        f"step 1/60 s, {speed} m/s": {"step": 1 / 60, "speed": float(speed)}
        for speed in (10, 1)
    }
    print_rows("pybox2d", version("box2d"), settings, after)
