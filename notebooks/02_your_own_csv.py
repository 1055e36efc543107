# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3 (ipykernel)
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Your own CSV file, from start to verdict
#
# *Course, part 2. Before: [fit a law](01_fit_newtons_cradle.ipynb). Next: [what the data can
# tell](03_what_the_data_can_tell.ipynb).*
#
# You will write a file of measured shots, check it, find a misread number, fit a law, choose
# between laws, and save a report.
#
# The example is an air track with three gliders that touch each other: 0.1, 0.2 and 0.1 kg. A
# camera measures all velocities before and after the impact, with an error of 0.5 cm/s.

# %%
# %matplotlib inline
import html
import io
from pathlib import Path
from tempfile import mkdtemp

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jimpact as ji

gliders = ji.chain([0.1, 0.2, 0.1])  # kg
ji.plot.system(gliders, [0.5, 0.0, 0.0], "Shot a: the first glider strikes the others")

# %% [markdown]
# ## From places to velocities
#
# A camera sees places. `ji.tracks.read` reads the file of a motion capture system, here of Qualisys:
# a column is a marker and an axis, the rate is the file's, and a marker that was not seen is NaN.
# The recording of shot a is computed, but like those that people make: 200 frames a second with
# errors of 0.05 mm, a table that is not quite level, and frames in which a hand hid a glider when
# they met.

# %%
t = np.arange(160) / 200  # s
since = t[:, None] - 0.4
before, after = np.array([0.5, 0.0, 0.0]), np.array([-0.163, 0.130, 0.390])  # m/s
places = (
    np.where(since < 0, before, after) * since + 0.03 * since**2 / 2 + [0.0, 0.1, 0.2]
)
places += 5e-5 * np.random.default_rng(0).normal(size=places.shape)
folder = Path(mkdtemp())
head = [
    "NO_OF_FRAMES\t160",
    "FREQUENCY\t200",
    "DATA_INCLUDED\t3D",
    "MARKER_NAMES\tleft\tmiddle\tright",
]
rows = []
for k, row in enumerate(1000 * places):  # mm
    hidden = [78 <= k < 86, False, False]
    cells = [
        f"{0 if lost else x:.3f}\t{0 if lost else 5:.3f}\t0.000"
        for x, lost in zip(row, hidden)
    ]
    rows.append("\t".join(cells))
recording = folder / "shot_a.tsv"
recording.write_text("\n".join([*head, *rows]))
t, seen = ji.tracks.read(recording, ["left x", "middle x", "right x"], unit="mm")
print(len(t), "frames,", int(np.isnan(seen).sum()), "places not seen")

# %% [markdown]
# `find_impacts` makes velocities before and after of them, with their errors. Do not differentiate
# or smooth across an impact. It looks for as many impacts as there is evidence for, says what
# candidates went, and warns of what does not look like flights between impacts: here the table.

# %%
track = ji.tracks.find_impacts(t, seen)
print(track)
assert len(track.impacts) == 1
track.plot("Three gliders, one impact")

# %% [markdown]
# `track.experiments(gliders, label="a")` are shots for `ji.fit`, and those of several recordings are
# added, `first + second`. Below the velocities of eight shots stand in
# a file.
#
# ## The file
#
# One line for each shot. The unit is part of the column name: here cm/s. Velocities to the right
# are positive. Write such a file with any editor or spreadsheet; this cell stands for it.

# %%
table = """\
shot,pre_1[cm/s],pre_2[cm/s],pre_3[cm/s],post_1[cm/s],post_2[cm/s],post_3[cm/s],sigma_1[cm/s],sigma_2[cm/s],sigma_3[cm/s]
a,50,0,0,-16.3,13.0,39.0,0.5,0.5,0.5
b,80,0,0,-28.0,22.6,61.9,0.5,0.5,0.5
c,0,0,-50,-42.0,-12.0,14.4,0.5,0.5,0.5
d,0,0,-80,-63.9,-19.0,23.6,0.5,0.5,0.5
e,50,0,-50,-54.9,11.3,31.1,0.5,0.5,0.5
f,80,0,-40,-57.3,23.0,51.5,0.5,0.5,0.5
g,60,0,0,-20.3,17.0,64.5,0.5,0.5,0.5
h,0,0,-60,-48.4,-14.0,17.6,0.5,0.5,0.5
"""
path = folder / "shots.csv"
path.write_text(table)
shots = ji.read_experiments(path)
print(shots.pre[0], "m/s before,", shots.post[0], "m/s after shot", shots.shots[0])

# %% [markdown]
# A mistake in the file is an error that names line and column:

# %%
wrong = folder / "wrong.csv"
wrong.write_text(table.replace("22.6", "22,6", 1))
try:
    ji.read_experiments(wrong)
except ValueError as error:
    print(str(error).replace(str(folder) + "/", ""))

# %% [markdown]
# ## Check the data before any law
#
# No law can reproduce shots that break the conservation of momentum. The ratio of momentum after to
# momentum before should be 1 within the errors.

# %%
momentum, energy = shots.momentum_ratio(gliders)[:, 0], shots.energy_ratio(gliders)
for shot, p, t in zip(shots.shots, momentum, energy):
    print(
        f"shot {shot}: momentum after / before {p:6.3f}, energy after / before {t:5.3f}"
    )

# %% [markdown]
# Shot g has 30 % too much momentum. (In shot e the total momentum is 0, so its ratio says nothing.)
# In the notebook of the laboratory the last number reads 46.5: two digits were swapped. Correct the
# file.

# %%
path.write_text(table.replace("64.5", "46.5"))
shots = ji.read_experiments(path)
print("shot g: momentum after / before", shots.momentum_ratio(gliders)[6, 0].round(3))

# %% [markdown]
# ## Fit a law
#
# `LZB`, the law of Liu, Zhao and Brogliato, has a coefficient of restitution and a stiffness for
# each contact. Both contacts are alike here, so they share one coefficient: equal numbers in a mask
# tie values, 0 keeps a value fixed. Only the ratio of the stiffnesses matters; the first stays 1.

# %%
free = {"restitution": [1, 1], "stiffness": [0, 1]}
fit = ji.fit(ji.LZB([0.9, 0.9], [1.0, 1.0]), gliders, shots, free)
print(fit)

# %% [markdown]
# Read the report from the top. The parameters come with standard errors and 95 % intervals. chi^2
# should be about as large as its degrees of freedom: then the residuals are as large as the stated
# errors. There are no warnings, so the law fits.

# %%
assert not fit.warnings
ji.plot.residuals(fit)

# %% [markdown]
# ## Would a simpler law do?
#
# `fit_laws` fits several laws to the same data. The first one in the list is the simplest that
# fits.

# %%
laws = ji.fit_laws(gliders, shots, ["newton", "moreau", "poisson", "lzb"])
print(laws)

# %% [markdown]
# ## Verdict
#
# One sentence for the paper, and one page for your colleagues. The file `fit.html` contains tables,
# pictures, versions and the seed.

# %%
print(laws.verdict)
print(fit.verdict)
page = folder / "fit.html"
picture = io.StringIO()
ji.plot.fit(fit).savefig(picture, format="svg")
text = f"<h1>{fit.verdict}</h1><pre>{html.escape(str(fit))}</pre>{picture.getvalue()}"
page.write_text(f"<!DOCTYPE html><meta charset='utf-8'>{text}", encoding="utf-8")
print(page.name, page.stat().st_size // 1000, "kB")

# %% [markdown]
# ## Exercises
#
# 1. Misread another number: write 61.9 of shot b as 69.1. Which line of the report would have told you?
# 2. Let each contact have its own coefficient. Do the two differ?
#
# Answers:

# %%
path.write_text(table.replace("64.5", "46.5").replace("61.9", "69.1"))
print(
    "1.",
    "\n   ".join(ji.fit(fit.law, gliders, ji.read_experiments(path), free).warnings),
)
each = ji.fit(fit.law, gliders, shots, {"restitution": [1, 2], "stiffness": [0, 1]})
print("2.", each.verdict)

# %% [markdown]
# The command line does all of this, too: `jimpact new fit my_fit` creates a study and a CSV file,
# `jimpact fit my_fit` prints the report.
#
# *Next: [how well a shot determines parameters](03_what_the_data_can_tell.ipynb).*
