// LZB impacts of a three-ball Hertz chain, one after the other on one thread: the yardstick.
//
// The method of jimpact/events/stepper.py, specialised: two contacts, eta = 1.5, e > 0, masses
// fixed over the batch. Event-aligned DOP853 in the time form, closed form for the contact that is
// left alone. `tableau.h` holds DOP853 and is written from jimpact/events/tableaux.py.
//
// State: indentations x1, x2 and gap velocities g1, g2;  x' = -c g,  g' = W F,  F = k x^1.5, with
// c = 1 in compression, 1/e^2 in expansion, and c = 0, F = 0 while open.

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "tableau.h"

namespace {

enum Phase { OPEN, COMPRESSION, EXPANSION };
enum Kind { TIME, START, ZERO_G, ROOT_X };

constexpr double FIRST_TIME = 0.05;   // of the fastest contact's time scale
constexpr double GROWTH = 6.0, SHRINK = 0.2, SAFETY = 0.8;
constexpr double SNAP = 1e-2;         // events closer than this part of the tolerance coincide
constexpr double NEGLIGIBLE = 0.1;    // approach, in tolerances, that does not close a contact
constexpr double CUT_SHORT = 0.7;
constexpr double INF = std::numeric_limits<double>::infinity();
constexpr int MOST_PASSES = 100000;

struct State { double x[2], g[2]; };
struct Rate { double x[2], g[2]; };

struct Flow {
    double w11, w12, w22;  // Delassus matrix
    double c[2];           // x' = -c g; 0 while open
    double k[2];           // stiffness; 0 while open
};

inline double three_halves(double x) { return x > 0.0 ? x * std::sqrt(x) : 0.0; }

inline Rate field(const Flow& f, const State& y) {
    const double f1 = f.k[0] * three_halves(y.x[0]), f2 = f.k[1] * three_halves(y.x[1]);
    return {{-f.c[0] * y.g[0], -f.c[1] * y.g[1]},
            {f.w11 * f1 + f.w12 * f2, f.w12 * f1 + f.w22 * f2}};
}

// sum over j < I of A[I][j] * k[j][component], zeros of the tableau left out at compile time
template <int I, int J = 0>
inline double weighted(const double (&k)[STAGES][4], int component, double sum) {
    if constexpr (J == I) {
        return sum;
    } else if constexpr (A[I][J] == 0.0) {
        return weighted<I, J + 1>(k, component, sum);
    } else {
        return weighted<I, J + 1>(k, component, sum + A[I][J] * k[J][component]);
    }
}

template <int J = 0>
inline void combine(const double (&k)[STAGES][4], int i, double& b, double& high, double& low) {
    if constexpr (J < STAGES) {
        if constexpr (B[J] != 0.0) b += B[J] * k[J][i];
        if constexpr (HIGH[J] != 0.0) high += HIGH[J] * k[J][i];
        if constexpr (LOW[J] != 0.0) low += LOW[J] * k[J][i];
        combine<J + 1>(k, i, b, high, low);
    }
}

// One stage: k[I] = length * dy/dxi
template <Kind K, int T, int I>
inline void stage(const Flow& f, const State& y, double start, double length,
                  double (&k)[STAGES][4]) {
    State at{{weighted<I>(k, 0, y.x[0]), weighted<I>(k, 1, y.x[1])},
             {weighted<I>(k, 2, y.g[0]), weighted<I>(k, 3, y.g[1])}};
    const double xi = start + C[I] * length;
    if constexpr (K == ZERO_G) at.g[T] = xi;
    if constexpr (K == ROOT_X) at.x[T] = xi * xi;
    const Rate r = field(f, at);
    double scale = length;
    if constexpr (K == START) scale *= 2.0 * xi;
    if constexpr (K == ZERO_G) scale /= r.g[T];
    if constexpr (K == ROOT_X) scale *= 2.0 * xi / r.x[T];
    k[I][0] = scale * r.x[0];
    k[I][1] = scale * r.x[1];
    k[I][2] = scale * r.g[0];
    k[I][3] = scale * r.g[1];
}

template <Kind K, int T, int... I>
inline void stages(const Flow& f, const State& y, double start, double length,
                   double (&k)[STAGES][4], std::integer_sequence<int, I...>) {
    (stage<K, T, I>(f, y, start, length, k), ...);
}

// One step; returns the error in units of the tolerance (`weight` = 1 / tolerance of y[i])
template <Kind K, int T>
double step(const Flow& f, const State& y, double start, double length, const double* weight,
            State& end) {
    double k[STAGES][4];
    stages<K, T>(f, y, start, length, k, std::make_integer_sequence<int, STAGES>());
    double fifth = 0.0, third = 0.0, b[4] = {y.x[0], y.x[1], y.g[0], y.g[1]};
    for (int i = 0; i < 4; ++i) {
        double high = 0.0, low = 0.0;
        combine(k, i, b[i], high, low);
        fifth = std::max(fifth, std::fabs(high) * weight[i]);
        third = std::max(third, std::fabs(low) * weight[i]);
        if (!(std::fabs(high) < INF)) fifth = INF;  // max() passes NaN over
    }
    end = {{b[0], b[1]}, {b[2], b[3]}};
    if constexpr (K == ZERO_G) end.g[T] = start + length;
    if constexpr (K == ROOT_X) end.x[T] = 0.0;
    const double scale = std::sqrt(fifth * fifth + 0.01 * third * third);
    return scale > 0.0 ? fifth * fifth / scale : fifth;
}

double any_step(Kind kind, int target, const Flow& f, const State& y, double start, double length,
                const double* weight, State& end) {
    switch (kind) {
        case TIME: return step<TIME, 0>(f, y, start, length, weight, end);
        case START: return step<START, 0>(f, y, start, length, weight, end);
        case ZERO_G:
            return target ? step<ZERO_G, 1>(f, y, start, length, weight, end)
                          : step<ZERO_G, 0>(f, y, start, length, weight, end);
        default:
            return target ? step<ROOT_X, 1>(f, y, start, length, weight, end)
                          : step<ROOT_X, 0>(f, y, start, length, weight, end);
    }
}

// First root in (0, 1] of the parabola through f0 >= 0, its slope there, and f1 < 0
double crossing(double f0, double f1, double slope) {
    f0 = std::max(f0, 0.0);
    const double a = f1 - f0 - slope;
    const double root = std::sqrt(std::max(slope * slope - 4 * a * f0, 0.0));
    const double u = slope <= 0 ? (root - slope == 0 ? 0.0 : 2 * f0 / (root - slope))
                                : (a == 0 ? 0.0 : (slope + root) / (-2 * a));
    return std::clamp(u, 0.0, 1.0);
}

// Least value of the cubic through both ends on its way down and up again, and where it is
double dip(double f0, double f1, double d0, double d1, double& u) {
    const double a = f1 - f0 - d0;
    u = std::clamp(a == 0 ? 1.0 : -d0 / (2 * a), 0.0, 1.0);
    return f0 * (1 + 2 * u) * (1 - u) * (1 - u) + d0 * u * (1 - u) * (1 - u) +
           f1 * u * u * (3 - 2 * u) + d1 * u * u * (u - 1);
}

struct Impact {
    Flow f{};
    State y{};
    Phase phase[2];
    double k[2], e[2];
    double tolerance;         // on gap velocities
    double weight[4];         // 1 / tolerance on x1, x2, g1, g2
    double shortest_time;     // of the two contacts' time scales
    int passes = 0;

    // The step about to be tried, and what is known where it begins
    Kind kind = START;
    int target = 0;
    double h = 0.0, begun = 0.0, due = 0.0;
    bool retargeted = false;
    Rate rate{};

    void set_phase(int j, Phase p) {
        phase[j] = p;
        f.c[j] = p == OPEN ? 0.0 : p == COMPRESSION ? 1.0 : 1.0 / (e[j] * e[j]);
        f.k[j] = p == OPEN ? 0.0 : k[j];
        if (p == OPEN) y.x[j] = 0.0;
    }

    double diagonal(int j) const { return j ? f.w22 : f.w11; }

    // Ends the impact where nothing is left, or one contact that does not press the other one
    bool finish() {
        bool work[2];
        for (int j = 0; j < 2; ++j) work[j] = y.x[j] > 0.0 || y.g[j] < -tolerance;
        if (work[0] == work[1]) return !work[0];
        const int j = work[0] ? 0 : 1, other = 1 - j;
        const double c = phase[j] == EXPANSION ? f.c[j] : 1.0;
        const double energy = 0.8 * k[j] * y.x[j] * three_halves(y.x[j]);
        const double end = e[j] * std::sqrt(diagonal(j) * energy + c * y.g[j] * y.g[j]);
        const double left = y.g[other] + f.w12 * (end - y.g[j]) / diagonal(j);
        if (left < -tolerance) return false;
        y = {{0.0, 0.0}, {j ? left : end, j ? end : left}};
        return true;
    }

    // Distances to a change of phase (x1, x2, g1, g2), >= 0 while it lasts, and their slopes
    void margins(const State& at, const Rate& r, double (&m)[4], double (&s)[4]) const {
        for (int j = 0; j < 2; ++j) {
            const double sign = phase[j] == COMPRESSION ? -1.0 : 1.0;
            m[j] = phase[j] == EXPANSION ? at.x[j] : 1.0;
            s[j] = phase[j] == EXPANSION ? r.x[j] : 0.0;
            m[2 + j] = sign * at.g[j] + (phase[j] == OPEN ? NEGLIGIBLE * tolerance : 0.0);
            s[2 + j] = sign * r.g[j];
        }
    }

    void change(int j, bool opens) {
        const Phase turned = y.x[j] > 0.0 ? EXPANSION : OPEN;
        set_phase(j, opens ? OPEN : phase[j] == COMPRESSION ? turned : COMPRESSION);
    }

    // Whether a change of phase lies inside the trial step; plans the next step if so
    bool event_inside(const State& end, const Rate& after, double span) {
        const double snap = SNAP * tolerance;
        const bool landing = kind == ZERO_G || kind == ROOT_X;
        double m0[4], m1[4], s0[4], s1[4];
        margins(y, rate, m0, s0);
        margins(end, after, m1, s1);
        double first = INF, first_dip = INF, u;
        int soonest = -1;
        for (int i = 0; i < 4; ++i) {
            if (landing && i == (kind == ROOT_X ? target : 2 + target)) continue;
            if (m1[i] < -snap) {
                const double least = 1e-13 * shortest_time;
                if ((i > 1 && m0[i] <= snap && s0[i] <= 0.0) || span < least) {
                    change(i & 1, i < 2);  // at once: it lies where the step begins
                    kind = kind == START ? START : TIME;
                    rate = field(f, y);
                    return true;
                }
                u = crossing(m0[i], m1[i], s0[i] * span);
                if (u < first) first = u, soonest = i;
            } else if (!landing && s0[i] < 0.0 && s1[i] > 0.0 && m0[i] > snap &&
                       dip(m0[i], m1[i], s0[i] * span, s1[i] * span, u) < -snap) {
                first_dip = std::min(first_dip, u);
            }
        }
        if (soonest < 0 && first_dip == INF) return false;
        const bool monotone = soonest >= 0 && first <= first_dip && s0[soonest] < 0.0 &&
                              (soonest < 2 || m0[soonest] > snap);
        first = std::min(first, first_dip);
        if (kind == START && begun == 0.0) {
            h *= CUT_SHORT * first;
        } else if (monotone && !retargeted) {
            if (kind == START) h = span;
            retargeted = landing;
            aim(soonest < 2 ? ROOT_X : ZERO_G, soonest & 1, first * span);
        } else {
            h = CUT_SHORT * first * span;
            kind = TIME;
            retargeted = false;
        }
        return true;
    }

    void aim(Kind at, int contact, double expected) {
        kind = at;
        target = contact;
        due = expected;
    }

    // Lands on an opening or a turning that is expected within the next step
    void anticipate() {
        double soonest = h;
        for (int j = 0; j < 2; ++j) {
            if (phase[j] == EXPANSION && rate.x[j] < 0.0 && y.x[j] < -soonest * rate.x[j]) {
                soonest = -y.x[j] / rate.x[j];
                aim(ROOT_X, j, soonest);
            }
            if (phase[j] == COMPRESSION && rate.g[j] > 0.0 && -y.g[j] < soonest * rate.g[j]) {
                soonest = -y.g[j] / rate.g[j];
                aim(ZERO_G, j, soonest);
            }
        }
    }

    void run() {
        for (int j = 0; j < 2; ++j) set_phase(j, y.g[j] <= 0.0 ? COMPRESSION : OPEN);
        h = std::sqrt(FIRST_TIME * shortest_time);
        rate = field(f, y);
        if (finish()) return;
        while (++passes < MOST_PASSES && !advance()) {
        }
    }

    // One pass; true where the impact is over
    bool advance() {
        const bool landing = kind == ZERO_G || kind == ROOT_X;
        double start = 0.0, length = h, span = h;
        if (kind == START) {
            start = begun;
            span = h * (2 * begun + h);
        } else if (kind == ZERO_G) {
            start = y.g[target];
            length = (phase[target] == OPEN ? -NEGLIGIBLE * tolerance : 0.0) - start;
        } else if (kind == ROOT_X) {
            start = std::sqrt(y.x[target]);
            length = -start;
        }
        if (landing) span = due;
        State end;
        const double error = any_step(kind, target, f, y, start, length, weight, end);
        const double eighth = std::sqrt(std::sqrt(std::sqrt(error + 1e-10)));
        const double factor = error < INF ? std::clamp(SAFETY / eighth, SHRINK, GROWTH) : SHRINK;
        if (!(error <= 1.0)) {
            h = landing ? 0.5 * span : factor * h;
            if (kind != START) kind = TIME;
            retargeted = false;
            return false;
        }
        const Rate after = field(f, end);
        if (event_inside(end, after, span)) return finish();
        y = end;
        rate = after;
        retargeted = false;
        if (landing) {
            change(target, kind == ROOT_X);
            rate = field(f, y);
            kind = TIME;
        } else {
            if (kind == START) begun += h;
            h *= factor;
        }
        if (finish()) return true;
        if (kind == TIME) anticipate();
        return false;
    }
};

}  // namespace

// `count` impacts of three balls: masses (3), velocity (3), stiffness and restitution (count, 2).
// out (count, 3): velocities after the impact; passes: total number of trial steps.
extern "C" void impacts(int count, const double* masses, const double* velocity,
                        const double* stiffness, const double* restitution, double rtol,
                        double* out, long* passes) {
    const double w[2] = {1 / masses[0] + 1 / masses[1], 1 / masses[1] + 1 / masses[2]};
    const double w12 = -1 / masses[1], det = w[0] * w[1] - w12 * w12;
    const double before[2] = {velocity[1] - velocity[0], velocity[2] - velocity[1]};
    double q = 0.0;
    for (int j = 0; j < 2; ++j) q = std::max(q, -before[j] / std::sqrt(w[j]));
    *passes = 0;
    for (int i = 0; i < count; ++i) {
        Impact impact;
        impact.f.w11 = w[0], impact.f.w12 = w12, impact.f.w22 = w[1];
        impact.tolerance = rtol * q * std::sqrt(std::min(w[0], w[1]));
        impact.shortest_time = INF;
        for (int j = 0; j < 2; ++j) {
            impact.k[j] = stiffness[2 * i + j];
            impact.e[j] = restitution[2 * i + j];
            const double x_ref = std::pow(1.25 * q * q / impact.k[j], 0.4);
            impact.y.g[j] = before[j];
            impact.weight[j] = 1 / (rtol * x_ref);
            impact.weight[2 + j] = 1 / (rtol * q * std::sqrt(w[j]));
            const double time = x_ref / (q * std::sqrt(w[j]));
            impact.shortest_time = std::min(impact.shortest_time, time);
        }
        impact.run();
        *passes += impact.passes;
        const double d1 = impact.y.g[0] - before[0], d2 = impact.y.g[1] - before[1];
        const double p1 = (w[1] * d1 - w12 * d2) / det, p2 = (w[0] * d2 - w12 * d1) / det;
        out[3 * i] = velocity[0] - p1 / masses[0];
        out[3 * i + 1] = velocity[1] + (p1 - p2) / masses[1];
        out[3 * i + 2] = velocity[2] + p2 / masses[2];
    }
}
