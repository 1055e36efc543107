"""What engines do today, beside the table: `python tests/validation/engines/run.py [ENGINE ...]`.

Runs the programs `engine_NAME.py` of this folder on `ji.data.ENGINE_SCENES`, and prints v+, the
nearest law, and by how much v+ differs from that in `ji.data.engine_impacts()`. Options:

    --env FOLDER    make an environment for each engine in this folder, with the packages that the
                    program names, and run it there; without, engines are those of this Python
    --python PATH   the Python of these environments (Drake asks for 3.12)
    --add FILE.csv  rows of another engine: columns engine, version, scene, setting, v1, v2, ...
                    [v1-]; velocities over that of ball 1 before
    --write         put all these rows into `jimpact/data/engine_impacts.csv`
"""

import argparse
import json
import re
import subprocess
import sys
import venv
from pathlib import Path

import nearest
import numpy as np

HERE = Path(__file__).parent
PROGRAMS = {
    path.stem.removeprefix("engine_"): path for path in sorted(HERE.glob("engine_*.py"))
}
SAME = 1.5e-3  # largest difference of velocities called the same: the table has three decimals
NEW, AS_BEFORE = "not in the table", "as in the table"


def packages(program):
    """What a program names in its first lines, as PEP 723 has it."""
    return re.findall(
        r'"([^"]+)"',
        re.search(r"^# dependencies = \[(.*)\]$", program.read_text(), re.M)[1],
    )


def python_of(name, folder, python):
    """The interpreter of an engine's environment, made if it does not exist."""
    inside = Path(folder).resolve() / name
    own = inside / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if not own.exists():
        if python:
            subprocess.run([python, "-m", "venv", inside], check=True)
        else:
            venv.create(inside, with_pip=True)
        install = [own, "-m", "pip", "install", "--quiet", *packages(PROGRAMS[name])]
        subprocess.run(
            install, check=False
        )  # if it fails, the program says what is missing
    return own


def measured(name, python):
    """Rows of an engine, or what to install."""
    scenes = {key: list(scene) for key, scene in nearest.SCENES.items()}
    done = subprocess.run(
        [python, PROGRAMS[name]],
        input=json.dumps(scenes),
        capture_output=True,
        text=True,
    )
    if "ModuleNotFoundError" in done.stderr:
        wanted = " ".join(f'"{package}"' for package in packages(PROGRAMS[name]))
        python = re.search(
            r'^# requires-python = "(.*)"$', PROGRAMS[name].read_text(), re.M
        )
        where = f" with a Python {python[1]}" if python else ""
        print(
            f"{name} is not installed: python -m pip install {wanted}{where}, or give --env FOLDER."
        )
        return []
    if done.returncode:
        raise SystemExit(f"{name} failed:\n{done.stderr}")
    return [
        json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")
    ]


def added(path):
    """Rows of another engine from a file; a row that does not fit its scene is an error."""
    rows = []
    for number, line in enumerate(nearest.read_table(path), 2):
        scene = nearest.SCENES.get(line.get("scene"))
        if scene is None:
            known = ", ".join(nearest.SCENES)
            raise SystemExit(
                f"{path}, line {number}: `scene` must be one of {known}, but is {line['scene']!r}."
            )
        given = [
            line[key] for key in line if re.fullmatch(r"v\d", key or "") and line[key]
        ]
        if len(given) != len(scene.masses):
            raise SystemExit(
                f"{path}, line {number}: {line['scene']} has {len(scene.masses)} balls, but "
                f"{len(given)} velocities are given."
            )
        try:
            velocity = [float(v) for v in given]
        except ValueError:
            velocity = [np.nan]
        if not np.isfinite(velocity).all():
            raise SystemExit(
                f"{path}, line {number}: velocities must be finite numbers, but are {given}."
            )
        own = {key: line[key] for key in ("engine", "version", "scene", "setting")}
        rows.append(own | {"velocity": velocity})
    return rows


def as_lines(rows):
    """Rows with a list of velocities as lines of the table, with their laws."""
    lines = []
    for row in rows:
        masses, wall, _ = nearest.SCENES[row["scene"]]
        m, v = np.array(masses), np.array(row["velocity"])
        line = {key: row[key] for key in ("engine", "version", "scene", "setting")}
        line |= {f"v{i + 1}": f"{v[i]:.3f}" if i < len(v) else "" for i in range(5)}
        line["momentum"] = "" if wall else f"{m @ v / m[0]:.3f}"
        line["energy_ratio"] = f"{m @ v**2 / m[0]:.3f}"
        lines.append(line)
    return list(nearest.with_laws(lines))


def velocity_of(line):
    """v+ (n,) of a line of the table."""
    return np.array([float(line[f"v{i}"]) for i in range(1, 6) if line[f"v{i}"]])


def key_of(line):
    """What tells one measurement from another."""
    return line["engine"], line["scene"], line["setting"]


def comparison(line, old):
    """A line beside that of the table, in words."""
    if old is None:
        return NEW
    off = np.abs(velocity_of(line) - velocity_of(old)).max()
    other = (
        f", there version {old['version']}" if old["version"] != line["version"] else ""
    )
    return (AS_BEFORE if off < SAME else f"differs by {off:.3f} from the table") + other


def report(line, told):
    """Print a line, and what was told of it."""
    v = " ".join(f"{x:+.3f}" for x in velocity_of(line))
    law = f"{line['nearest_law']}, e = {line['nearest_e']}, off by {line['distance']}"
    print(f"{line['engine']} {line['version']}, {line['scene']}, {line['setting']}")
    print(f"    {v}   energy {line['energy_ratio']}   {law}   {told}")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "engines", nargs="*", metavar="ENGINE", help=", ".join(PROGRAMS)
    )
    for option in ("--env", "--python", "--add"):
        parser.add_argument(option)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    unknown = [name for name in given.engines if name not in PROGRAMS]
    if unknown:
        parser.error(
            f"no such engine: {', '.join(unknown)}; there are {', '.join(PROGRAMS)}"
        )
    rows = added(given.add) if given.add else []
    for name in given.engines or ([] if given.add else PROGRAMS):
        python = (
            python_of(name, given.env, given.python) if given.env else sys.executable
        )
        rows += measured(name, python)
    merged = {key_of(line): line for line in nearest.read_table()}
    for line in as_lines(rows):
        told = comparison(line, merged.get(key_of(line)))
        report(line, told)
        if told != AS_BEFORE:
            merged[key_of(line)] = line
    if given.write:
        nearest.write_table(list(merged.values()))


if __name__ == "__main__":
    main()
