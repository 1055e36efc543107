#!/usr/bin/env bash
# pymunk (Chipmunk): what a row of balls that touch does depends on their number.
#
# Guess: with elasticity 1 a row of five balls does what a row of three does: the last ball flies off
# with the speed of the first (Newton's cradle), as the solver takes contacts one after another.
# Seen (pymunk 7.3.1): three balls (0, 0, 1); five balls (-1/3, 0, 0, 2/3, 2/3), with the energy kept.
# It costs: a law that was fitted to three balls of this engine is wrong for five.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "pymunk==7.3.1"
"$folder/env/bin/python" - <<'PYTHON'
import pymunk


def after(count):
    """Velocities along x of a row of discs of radius .1 m and 1 kg, the first of which comes at 1 m/s."""
    space, bodies = pymunk.Space(), []
    for k in range(count):
        body = pymunk.Body(1.0, pymunk.moment_for_circle(1.0, 0, 0.1))
        body.position = 0.2 * k, 0.0
        circle = pymunk.Circle(body, 0.1)
        circle.elasticity, circle.friction = 1.0, 0.0
        space.add(body, circle)
        bodies.append(body)
    bodies[0].velocity = 1.0, 0.0
    for _ in range(120):
        space.step(1 / 60)
    return [round(body.velocity.x, 3) + 0.0 for body in bodies]


print("pymunk", pymunk.version)
three, five = after(3), after(5)
print("three balls", three)
print("five balls ", five)
assert three == [0.0, 0.0, 1.0], "the behaviour has changed"
assert all(abs(v - w) < 2e-3 for v, w in zip(five, [-1 / 3, 0, 0, 2 / 3, 2 / 3])), "it has changed"
PYTHON
