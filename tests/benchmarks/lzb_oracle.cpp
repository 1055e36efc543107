// Reference outcomes of the LZB law on chains, in 80-bit precision; shares nothing with the package.
//
//   M v' = N F,  F_j = k_j x_j^eta,  x_j' = -c_j gamma_j,  c_j = 1 (compression), 1/e_j^2 (expansion)
//
// with units and time as they are, DOP853 in `long double`, the end of a phase found by bisection
// on the step. e = 0 is the jump at gamma_j = 0 from x0 to the x1 with
// W_jj k (x0^(eta+1) - x1^(eta+1)) / (eta+1) + S (x0 - x1) = 0, S the other contacts' pull.
// Reads lines "n eta e m_1..m_n k_1..k_(n-1) v_1..v_n", writes "end steps phases v_1..v_n";
// end: 0 over, 1 over after more than ENDLESS closings of one contact, 2 given up.
// Arguments: tolerance, largest number of steps, processor seconds a line may take.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>
#include "dop853.h"  // STAGES, A, B, E3, E5; `stability_reference.py` writes it from scipy

typedef long double real;
typedef std::vector<real> vec;
enum { OPEN, COMPRESSION, EXPANSION };
const int ENDLESS = 3;
const real SLACK = 1e-15L;  // approach below this part of the largest speed does not close
const real NOTHING = 1e-28L;  // energy left, of that before: the impact is over

struct Chain {
  int m;
  real eta, e, speed;
  vec mass, k, diagonal, off, gamma0;
  std::vector<int> phase;

  real force(real x, int j) const { return x > 0 ? k[j] * std::pow(x, eta) : 0; }
  real gamma(const vec& y, int j) const {
    real sum = gamma0[j] + diagonal[j] * y[m + j];
    if (j > 0) sum += off[j - 1] * y[m + j - 1];
    if (j < m - 1) sum += off[j] * y[m + j + 1];
    return sum;
  }
  void rates(const vec& y, vec& out) const {
    for (int j = 0; j < m; ++j) {
      real g = gamma(y, j);
      out[j] = phase[j] == OPEN ? 0 : phase[j] == COMPRESSION ? -g : -g / (e * e);
      out[m + j] = phase[j] == OPEN ? 0 : force(y[j], j);
    }
  }
  bool changes(const vec& y, int j) const {
    real g = gamma(y, j);
    if (phase[j] == COMPRESSION) return g > 0;
    if (phase[j] == EXPANSION) return g < 0 || y[j] < 0;
    return g < -SLACK * speed;
  }
  bool any_changes(const vec& y) const {
    for (int j = 0; j < m; ++j)
      if (changes(y, j)) return true;
    return false;
  }
  real left(const vec& y) const {  // energy of loads and approaches
    real sum = 0;
    for (int j = 0; j < m; ++j) {
      real g = std::min(gamma(y, j), (real)0);
      if (y[j] > 0 && phase[j] != OPEN) sum += k[j] * std::pow(y[j], eta + 1) / (eta + 1);
      sum += g * g / diagonal[j] / 2;
    }
    return sum;
  }
  void jump(vec& y, int j) {  // e = 0
    real s = 0, w = diagonal[j] * k[j] / (eta + 1), x0 = y[j];
    if (j > 0) s += off[j - 1] * force(y[j - 1], j - 1);
    if (j < m - 1) s += off[j] * force(y[j + 1], j + 1);
    auto rest = [&](real x) { return w * (std::pow(x0, eta + 1) - std::pow(x, eta + 1)) + s * (x0 - x); };
    real top = std::pow(std::max(-s, (real)0) / (diagonal[j] * k[j]), 1 / eta);
    if (s >= 0 || rest(0) > 0 || top >= x0) {
      y[j] = top >= x0 && s < 0 ? x0 : 0;
      phase[j] = y[j] > 0 || s < 0 ? COMPRESSION : OPEN;
      return;
    }
    real low = 0, high = top;  // rest(low) <= 0 < rest(high)
    for (int i = 0; i < 200; ++i) (rest((low + high) / 2) <= 0 ? low : high) = (low + high) / 2;
    y[j] = (low + high) / 2;
    phase[j] = COMPRESSION;
  }
};

struct Stepper {
  Chain& chain;
  const vec& scale;
  std::vector<vec> slopes;
  vec at;
  Stepper(Chain& c, const vec& s)
      : chain(c), scale(s), slopes(STAGES, vec(2 * c.m)), at(2 * c.m) {}

  real step(const vec& y, real h, vec& out) {
    int n = y.size();
    for (int i = 0; i < STAGES; ++i) {
      for (int q = 0; q < n; ++q) {
        real sum = 0;
        for (int l = 0; l < i; ++l) sum += A[i][l] * slopes[l][q];
        at[q] = y[q] + h * sum;
      }
      chain.rates(at, slopes[i]);
    }
    real worst = 0;
    for (int q = 0; q < n; ++q) {
      real sum = 0, fifth = 0, third = 0;
      for (int l = 0; l < STAGES; ++l) {
        sum += B[l] * slopes[l][q];
        fifth += E5[l] * slopes[l][q];
        third += E3[l] * slopes[l][q];
      }
      out[q] = y[q] + h * sum;
      fifth = std::fabs(h * fifth / scale[q]);
      third = std::fabs(h * third / scale[q]);
      real size = std::sqrt(fifth * fifth + 0.01L * third * third);
      worst = std::max(worst, size > 0 ? fifth * fifth / size : fifth);
    }
    return worst;
  }
};

int solve(Chain& c, real tolerance, long most, double seconds, vec& y, long& steps, long& phases) {
  int m = c.m;
  std::clock_t began = std::clock();
  vec scale(2 * m), fresh(2 * m), trial(2 * m);
  std::vector<long> closings(m, 0);
  real h = INFINITY, before = 0;
  for (int j = 0; j < m; ++j) {
    real reference = std::pow((c.eta + 1) * c.speed * c.speed / (2 * c.k[j] * c.diagonal[j]), 1 / (c.eta + 1));
    scale[j] = tolerance * reference;
    scale[m + j] = tolerance * c.speed / c.diagonal[j];
    h = std::min(h, 1e-3L * reference / c.speed);
    c.phase[j] = c.gamma0[j] <= 0 ? COMPRESSION : OPEN;
    before += std::pow(std::min(c.gamma0[j], (real)0), 2) / c.diagonal[j] / 2;
  }
  Stepper stepper(c, scale);
  steps = phases = 0;
  while (c.left(y) > NOTHING * before) {
    if (++steps > most) return 2;
    if (steps % 1000 == 0 && double(std::clock() - began) / CLOCKS_PER_SEC > seconds) return 2;
    real error = stepper.step(y, h, fresh);
    if (!(error <= 1)) {
      h *= std::isfinite(error) ? std::max((real)0.2, 0.8L * std::pow(error, -1.0L / 8)) : 0.2L;
      continue;
    }
    real next = h * std::min((real)4, 0.8L * std::pow(error + 1e-12L, -1.0L / 8));
    if (c.any_changes(fresh)) {
      real low = 0, high = h;
      for (int i = 0; i < 64; ++i) {
        real middle = (low + high) / 2;
        stepper.step(y, middle, trial);
        (c.any_changes(trial) ? high : low) = middle;
      }
      stepper.step(y, high, fresh);
      next = h;
      ++phases;
      for (int j = 0; j < m; ++j) {
        if (!c.changes(fresh, j)) continue;
        if (c.phase[j] == EXPANSION && fresh[j] <= 0) {
          c.phase[j] = OPEN;
          fresh[j] = 0;
        } else if (c.phase[j] == COMPRESSION) {
          if (fresh[j] <= 0) { c.phase[j] = OPEN; fresh[j] = 0; }
          else if (c.e == 0) c.jump(fresh, j);
          else c.phase[j] = EXPANSION;
        } else {
          if (c.phase[j] == OPEN) ++closings[j];
          c.phase[j] = COMPRESSION;
        }
      }
      if (c.e > 0 && c.e < 0.1L) next = std::min(next, h * c.e);
    }
    y = fresh;
    h = next;
  }
  return *std::max_element(closings.begin(), closings.end()) >= ENDLESS ? 1 : 0;
}

int main(int count, char** given) {
  if (count < 4) return 1;
  real tolerance = strtold(given[1], nullptr);
  long most = atol(given[2]);
  double seconds = atof(given[3]);
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream in(line);
    int n;
    Chain c;
    in >> n >> c.eta >> c.e;
    c.m = n - 1;
    vec v(n);
    c.mass.resize(n);
    c.k.resize(n - 1);
    for (auto* row : {&c.mass, &c.k, &v})
      for (auto& value : *row) in >> value;
    c.diagonal.resize(c.m);
    c.off.assign(c.m, 0);
    c.gamma0.resize(c.m);
    c.phase.resize(c.m);
    c.speed = 0;
    for (auto each : v) c.speed = std::max(c.speed, std::fabs(each));
    for (int j = 0; j < c.m; ++j) {
      c.diagonal[j] = 1 / c.mass[j] + 1 / c.mass[j + 1];
      if (j < c.m - 1) c.off[j] = -1 / c.mass[j + 1];
      c.gamma0[j] = v[j + 1] - v[j];
    }
    vec y(2 * c.m, 0);
    long steps, phases;
    int end = solve(c, tolerance, most, seconds, y, steps, phases);
    printf("%d %ld %ld", end, steps, phases);
    for (int i = 0; i < n; ++i) {
      real push = (i > 0 ? y[c.m + i - 1] : 0) - (i < n - 1 ? y[c.m + i] : 0);
      printf(" %.18Lg", v[i] + push / c.mass[i]);
    }
    printf("\n");
    fflush(stdout);
  }
}
