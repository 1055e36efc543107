"""What the programs of engines share: scenes on standard input, velocities on standard output.

A program `engine_NAME.py` imports its engine and this file only, so that it runs in an environment
without jimpact. Its first lines name the packages it needs, as PEP 723 has it. It defines
`after(masses, wall, restitution, **setting)`: v+ (n,) [m/s], or None for a scene that it cannot
express. Balls of radius `RADIUS` stand in a row along x and touch, ball 1 comes at `speed` [m/s]
(1 unless the setting has another one), a wall stands on the right of the last ball.
"""

import functools
import json
import sys

RADIUS = 0.1  # of each ball [m]; contact forces with damping and thresholds of speed depend on it
TIME = 0.5  # of a run of an engine that takes steps [s]; every impact here ends within .1 s


@functools.cache
def scenes():
    """Name -> (masses, wall, restitution), from standard input."""
    return json.load(sys.stdin)


def print_rows(engine, version, settings, after):
    """A row of JSON for each scene of standard input and each setting (name -> keywords)."""
    for scene, (masses, wall, restitution) in scenes().items():
        for setting, keywords in settings.items():
            speed = keywords.get("speed", 1.0)
            found = after(masses, wall, restitution, **keywords)
            if found is not None:
                velocity = [round(float(v) / speed, 6) for v in found]
                row = {
                    "engine": engine,
                    "version": version,
                    "scene": scene,
                    "setting": setting,
                }
                print(json.dumps(row | {"velocity": velocity}), flush=True)


def root_of_product(restitution):
    """What each of two bodies is given where the engine multiplies the values of both."""
    return restitution**0.5
