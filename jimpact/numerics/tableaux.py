"""Runge-Kutta tableaux: a method is data.

`DOP853` is Dormand and Prince's 8(5,3) pair: 12 stages, order 8, with a fifth- and a
third-order error estimate. Source: Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I (2nd ed., 1993), II.5, II.10 and the coefficients of their code
DOP853.
"""

import re
from typing import NamedTuple


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method: strictly lower triangular a, weights b, nodes c.

    Stage i is at `y + h sum_j a_ij k_j` and the time `t + c_i h`, the end at
    `y + h sum_i b_i k_i`.
    """

    order: int
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]
    error_high: tuple[float, ...]  # weights of the error estimate of the higher order
    # weights of the one of lower order, to combine with it
    error_low: tuple[float, ...]


def _numbers(text: str) -> tuple[float, ...]:
    """The numbers of a text, with spaces between them."""
    return tuple(float(number) for number in text.split())


# a_ij: behind the number of each stage i its coefficients of the stages j < i
_COEFFICIENTS = """
 1:
 2: 0.05260015195876773
 3: 0.0197250569845379 0.0591751709536137
 4: 0.02958758547680685 0 0.08876275643042054
 5: 0.2413651341592667 0 -0.8845494793282861 0.924834003261792
 6: 0.037037037037037035 0 0 0.17082860872947386 0.12546768756682242
 7: 0.037109375 0 0 0.17025221101954405 0.06021653898045596 -0.017578125
 8: 0.03709200011850479 0 0 0.17038392571223998 0.10726203044637328
    -0.015319437748624402 0.008273789163814023
 9: 0.6241109587160757 0 0 -3.3608926294469414 -0.868219346841726 27.59209969944671
    20.154067550477894 -43.48988418106996
10: 0.47766253643826434 0 0 -2.4881146199716677 -0.590290826836843
    21.230051448181193 15.279233632882423 -33.28821096898486 -0.020331201708508627
11: -0.9371424300859873 0 0 5.186372428844064 1.0914373489967295 -8.149787010746927
    -18.52006565999696 22.739487099350505 2.4936055526796523 -3.0467644718982196
12: 2.273310147516538 0 0 -10.53449546673725 -2.0008720582248625 -17.9589318631188
    27.94888452941996 -2.8589982771350235 -8.87285693353063 12.360567175794303
    0.6433927460157636
"""

# a row for each stage: its node c, its weight b, its weights in both error estimates
_WEIGHTS = """
   0                   0.054293734116568765  0.01312004499419488  -0.18980075407240762
   0.05260015195876773 0                     0                     0
   0.0789002279381516  0                     0                     0
   0.1183503419072274  0                     0                     0
   0.2816496580927726  0                     0                     0
   0.3333333333333333  4.450312892752409    -1.2251564463762044    4.450312892752409
   0.25                1.8915178993145003   -0.4957589496572502    1.8915178993145003
   0.3076923076923077 -5.801203960010585     1.6643771824549864   -5.801203960010585
   0.6512820512820513  0.3111643669578199   -0.35032884874997366  -0.4226823213237919
   0.6                -0.1521609496625161    0.3341791187130175   -0.1521609496625161
   0.8571428571428571  0.20136540080403034   0.08192320648511571   0.20136540080403034
   1.0                 0.04471061572777259  -0.022355307863886294  0.02265179219836082
"""


def _tableau(order: int, coefficients: str, weights: str) -> Tableau:
    """The method of two tables: coefficients `i: a_i1 a_i2 ..`, and rows of weights."""
    _, *stages = re.split(r"\d+:", coefficients)
    a = tuple(_numbers(stage) for stage in stages)
    rows = [_numbers(row) for row in weights.strip().splitlines()]
    c, b, error_high, error_low = zip(*rows, strict=True)
    return Tableau(order, a, b, c, error_high, error_low)


DOP853 = _tableau(8, _COEFFICIENTS, _WEIGHTS)
