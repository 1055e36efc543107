#!/usr/bin/env bash
# C3D: a lost marker and the number of the first frame differ between two readers of one file.
#
# Guess: two readers of the same file agree on the first frame, and mark a lost marker (residual -1)
# alike, as NaN.
# Seen (c3d 0.6.0 and ezc3d 1.7.2): frames count from 1 and from 0; the lost marker is at its last
# place (with the residual -1 beside it), and NaN.
# It costs: with the first reader a ball seems to stand still where it was lost, which is an impact.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "c3d==0.6.0" "ezc3d==1.7.2" "numpy<2.5"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
import c3d
import ezc3d
import numpy as np

writer = c3d.Writer(point_rate=100.0)
frames = []
for k in range(6):
    lost = k == 3
    x = 10.0 * (k - lost)  # [mm]; a lost marker keeps its last place in the file
    frames.append((np.array([[x, 0.0, 0.0, -1.0 if lost else 0.0, 0.0]]), np.zeros((0, 0))))
writer.add_frames(frames)
writer.set_point_labels(["ball"])
with open("ball.c3d", "wb") as file:
    writer.write(file)

with open("ball.c3d", "rb") as file:
    reader = c3d.Reader(file)
    rows = [(number, points[0]) for number, points, _ in reader.read_frames()]
other = ezc3d.c3d("ball.c3d")
first = rows[0][0], int(other["header"]["points"]["first_frame"])
here, there = rows[3][1], other["data"]["points"][:3, 0, 3]
print("first frame: c3d", first[0], "ezc3d", first[1])
print("lost marker: c3d", here[:3].tolist(), "residual", float(here[3]), "ezc3d", there.tolist())
assert first == (1, 0), "the behaviour has changed"
assert here[:3].tolist() == [20.0, 0.0, 0.0], "the behaviour has changed"
assert here[3] < 0, "the behaviour has changed"
assert np.isnan(there).all(), "the behaviour has changed"
PYTHON
