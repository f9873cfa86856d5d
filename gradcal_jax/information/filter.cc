// The filter of `whitening.py` and the derivative of `adjoint.py`, reading by reading, in machine code: one pass through
// the data without leaving the cache. `native.py` compiles it for a number of noise states (STATES) and a precision
// (REAL) and hands it to JAX. Arrays are as there, row-major; all but `STATES` is known only when it is called, and any
// number of problems of one shape may stand one after the other.

#include <algorithm>
#include <cmath>
#include <memory>

#include "panels.h"

namespace {

constexpr int n = STATES;
// From here on the states are gone through by what is not zero: several channels share few states, and most of their
// readings follow one another without a step.
constexpr bool WIDE = n >= 8;

// The steps of one problem: `transition` and `noise` of the step that leads to each reading.
struct Steps {
  const Real *transition, *noise, *observation, *variance;
  const bool* used;
};

// What the derivative needs of the filter at each reading: x and P before it, P Hᵀ/S and 1/√S.
template <typename T>
struct Kept {
  T *state, *covariance, *gain, *per_std;
};

// --- many states ------------------------------------------------------------------------------------------------------

// What is not zero of a matrix, row by row, or of a vector (one row).
template <int ROWS>
struct Sparse {
  int begin[ROWS + 1], place[ROWS * n];
  Real value[ROWS * n];

  explicit Sparse(const Real* from) {
    int count = 0;
    for (int i = 0; i < ROWS; ++i) {
      begin[i] = count;
      for (int j = 0; j < n; ++j)
        if (from[i * n + j] != 0) {
          place[count] = j;
          value[count++] = from[i * n + j];
        }
    }
    begin[ROWS] = count;
  }
  // `each(row, column, value)`.
  template <typename Each>
  void go(Each each) const {
    for (int i = 0; i < ROWS; ++i)
      for (int a = begin[i]; a < begin[i + 1]; ++a) each(i, place[a], value[a]);
  }
};

// Whether the step that leads to a reading changes nothing: the state is then the same as at the reading before, and
// so is what all columns say of it.
bool stays(const Steps& steps, int64_t k) {
  const Real *F = steps.transition + k * n * n, *Q = steps.noise + k * n * n;
  bool same = k > 0;
  for (int i = 0; i < n && same; ++i)
    for (int j = 0; j < n; ++j) same &= F[i * n + j] == (i == j ? 1 : 0) && Q[i * n + j] == 0;
  return same;
}

// States before a reading are kept where a step that changes them follows.
bool keeps(const Steps& steps, int64_t k, int64_t count) { return k + 1 == count || !stays(steps, k + 1); }

void filter_wide(int64_t count, int64_t p, Steps steps, const Real* mean, const Real* covariance, const Real* columns,
                 Real* rows, Real* mean_after, Real* covariance_after, const Kept<Real>* kept) {
  const std::unique_ptr<Vec[]> state(new Vec[panels(p) * n]);
  for_panels(p, [&](int64_t c, int64_t left, auto whole) {
    for (int i = 0; i < n; ++i) state[c * n + i] = load(mean + i * p + c * LANES, left, whole);
  });
  Real P[n][n];
  std::copy_n(covariance, n * n, &P[0][0]);
  for (int64_t k = 0; k < count; ++k) {
    const bool still = stays(steps, k), keep = kept && keeps(steps, k, count);
    const Real* Q = steps.noise + k * n * n;
    const Sparse<n> F(steps.transition + k * n * n);
    const Sparse<1> H(steps.observation + k * n);
    Real PH[n] = {}, gain[n], S = steps.variance[k];
    if (!still) {
      // P' = F (F P)' + Q, of which the lower half counts.
      Real FP[n][n] = {}, turned[n][n];
      F.go([&](int i, int l, Real f) {
        for (int j = 0; j < n; ++j) FP[i][j] += f * P[l][j];
      });
      for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) turned[j][i] = FP[i][j];
      std::copy_n(Q, n * n, &P[0][0]);
      F.go([&](int i, int l, Real f) {
        for (int j = 0; j < n; ++j) P[i][j] += f * turned[l][j];
      });
      for (int i = 0; i < n; ++i)
        for (int j = 0; j < i; ++j) P[j][i] = P[i][j];
    }
    H.go([&](int, int l, Real h) {
      for (int i = 0; i < n; ++i) PH[i] += h * P[l][i];
    });
    H.go([&](int, int l, Real h) { S += h * PH[l]; });
    const Real reciprocal = steps.used[k] && S > 0 ? 1 / S : 0, per_std = std::sqrt(reciprocal);
    for (int i = 0; i < n; ++i) gain[i] = PH[i] * reciprocal;
    if (kept) {
      if (keep) std::copy_n(&P[0][0], n * n, kept->covariance + k * n * n);
      std::copy_n(gain, n, kept->gain + k * n);
      kept->per_std[k] = per_std;
    }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) P[i][j] -= gain[i] * PH[j];
    for_panels(p, [&](int64_t c, int64_t left, auto whole) {
      const int64_t a = c * LANES;
      Vec* x = &state[c * n];
      if (!still) {
        Vec stepped[n] = {};
        F.go([&](int i, int l, Real f) { stepped[i] += f * x[l]; });
        std::copy_n(stepped, n, x);
      }
      if (keep)
        for (int i = 0; i < n; ++i) store(kept->state + (k * n + i) * p + a, left, x[i], whole);
      Vec innovation = load(columns + k * p + a, left, whole);
      H.go([&](int, int l, Real h) { innovation -= h * x[l]; });
      store(rows + k * p + a, left, per_std * innovation, whole);
      if (reciprocal > 0)
        for (int i = 0; i < n; ++i) x[i] += gain[i] * innovation;
    });
  }
  for_panels(p, [&](int64_t c, int64_t left, auto whole) {
    for (int i = 0; i < n; ++i) store(mean_after + i * p + c * LANES, left, state[c * n + i], whole);
  });
  std::copy_n(&P[0][0], n * n, covariance_after);
}

// Products over all columns go through registers, BLOCK × BLOCK at a time; `PAD` states, those beyond n zero.
constexpr int BLOCK = 4, PAD = (n + BLOCK - 1) / BLOCK * BLOCK;
using States = Vec[PAD];

// `factor · Σ_c left_i right_j`, of the blocks that reach below the diagonal, or all.
void products(int64_t panels, const States* left, const States* right, bool lower, Real factor, Real* out) {
  for (int i = 0; i < PAD; i += BLOCK)
    for (int j = 0; j < (lower ? i + BLOCK : PAD); j += BLOCK) {
      Vec sum[BLOCK][BLOCK] = {};
      for (int64_t c = 0; c < panels; ++c)
        for (int a = 0; a < BLOCK; ++a)
          for (int b = 0; b < BLOCK; ++b) sum[a][b] += left[c][i + a] * right[c][j + b];
      for (int a = 0; a < BLOCK && i + a < n; ++a)
        for (int b = 0; b < BLOCK && j + b < n; ++b) out[(i + a) * n + j + b] = factor * total(sum[a][b]);
    }
}

// `start + P right`.
void smooth(const Real* P, const Vec* right, Vec* start) {
  for (int j = 0; j < PAD; j += BLOCK) {
    Vec sum[BLOCK] = {};
    for (int l = 0; l < n; ++l)
      for (int b = 0; b < BLOCK; ++b) sum[b] += P[std::min(j + b, n - 1) * n + l] * right[l];
    for (int b = 0; b < BLOCK && j + b < n; ++b) start[j + b] += sum[b];
  }
}

// Whitened `rows` of all columns, and state and covariance after the last reading.
void filter(int64_t count, int64_t p, Steps steps, const Real* mean, const Real* covariance, const Real* columns,
            Real* rows, Real* mean_after, Real* covariance_after, const Kept<Real>* kept) {
  if constexpr (WIDE)
    return filter_wide(count, p, steps, mean, covariance, columns, rows, mean_after, covariance_after, kept);
  const std::unique_ptr<Vec[]> state(new Vec[panels(p) * n]);
  for_panels(p, [&](int64_t c, int64_t left, auto whole) {
    for (int i = 0; i < n; ++i) state[c * n + i] = load(mean + i * p + c * LANES, left, whole);
  });
  Real P[n][n];
  std::copy_n(covariance, n * n, &P[0][0]);
  for (int64_t k = 0; k < count; ++k) {
    const Real *F = steps.transition + k * n * n, *Q = steps.noise + k * n * n, *H = steps.observation + k * n;
    Real FP[n][n], PH[n], gain[n], S = steps.variance[k];
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) {
        FP[i][j] = 0;
        for (int l = 0; l < n; ++l) FP[i][j] += F[i * n + l] * P[l][j];
      }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) {
        Real sum = Q[i * n + j];
        for (int l = 0; l < n; ++l) sum += FP[i][l] * F[j * n + l];
        P[i][j] = P[j][i] = sum;
      }
    for (int i = 0; i < n; ++i) {
      PH[i] = 0;
      for (int l = 0; l < n; ++l) PH[i] += P[i][l] * H[l];
      S += H[i] * PH[i];
    }
    // Nothing is learnt where there is no reading, or one that is known beforehand.
    const Real reciprocal = steps.used[k] && S > 0 ? 1 / S : 0, per_std = std::sqrt(reciprocal);
    for (int i = 0; i < n; ++i) gain[i] = PH[i] * reciprocal;
    if (kept) {
      std::copy_n(&P[0][0], n * n, kept->covariance + k * n * n);
      std::copy_n(gain, n, kept->gain + k * n);
      kept->per_std[k] = per_std;
    }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) P[i][j] -= gain[i] * PH[j];
    for_panels(p, [&](int64_t c, int64_t left, auto whole) {
      const int64_t a = c * LANES;
      Vec *x = &state[c * n], before[n], innovation = load(columns + k * p + a, left, whole);
      for (int i = 0; i < n; ++i) {
        before[i] = F[i * n] * x[0];
        for (int l = 1; l < n; ++l) before[i] += F[i * n + l] * x[l];
      }
      for (int i = 0; i < n; ++i) innovation -= H[i] * before[i];
      store(rows + k * p + a, left, per_std * innovation, whole);
      if (kept)
        for (int i = 0; i < n; ++i) store(kept->state + (k * n + i) * p + a, left, before[i], whole);
      for (int i = 0; i < n; ++i) x[i] = before[i] + gain[i] * innovation;
    });
  }
  for_panels(p, [&](int64_t c, int64_t left, auto whole) {
    for (int i = 0; i < n; ++i) store(mean_after + i * p + c * LANES, left, state[c * n + i], whole);
  });
  std::copy_n(&P[0][0], n * n, covariance_after);
}

// Cotangents of a filter that began with states of zero, for the cotangent Ḡ of `rowsᵀ rows`, symmetric.
//
// With u, ρ, ẑ as in `adjoint.py`: 2 uḠ of a reading's columns, −uḠuᵀ of its variance, −2 uḠẑᵀ of H; of the step that
// leads to it −2 ρḠẑᵀ, ẑ at the reading before, for F and −ρḠρᵀ for Q. uḠ and ρḠ obey the recursions of u and ρ, with
// `weighed`, which is rows times Ḡ, in the place of `rows`.
struct Cotangents {
  Real *transition, *noise, *observation, *variance, *initial, *columns;
};

// Of a reading to which no step leads (`fixed`, `NoiseSteps.stays`) nobody asks for those of F and Q.
void pull_wide(int64_t count, int64_t p, Steps steps, const Real* initial, const bool* fixed, const Real* rows,
               const Real* weighed, Kept<const Real> kept, Cotangents of) {
  const int64_t m = panels(p);
  // As in `pull`, of all panels; `smoothed` ẑ at the reading, the same for all that follow one another without a step.
  const std::unique_ptr<States[]> rho(new States[m]()), rho_weighed(new States[m]()), before_step(new States[m]()),
      smoothed(new States[m]());
  const std::unique_ptr<Vec[]> w(new Vec[m]());
  for (int64_t k = count - 1; k >= 0; --k) {
    const bool still = stays(steps, k), keep = keeps(steps, k, count);
    const Sparse<1> H(steps.observation + k * n);
    const Real *gain = kept.gain + k * n, per_std = kept.per_std[k];
    Vec by_variance = {};
    for_panels(p, [&](int64_t c, int64_t left, auto whole) {
      const int64_t a = c * LANES;
      Vec u = {}, v = {};
      if (per_std > 0) {
        u = per_std * load(rows + k * p + a, left, whole), v = per_std * load(weighed + k * p + a, left, whole);
        for (int i = 0; i < n; ++i) {
          u -= gain[i] * rho[c][i];
          v -= gain[i] * rho_weighed[c][i];
        }
        H.go([&](int, int l, Real h) {
          rho[c][l] += h * u;
          rho_weighed[c][l] += h * v;
        });
      }
      store(of.columns + k * p + a, left, v + v, whole);
      by_variance += u * v;
      w[c] = v;
      if (keep) {
        for (int j = 0; j < n; ++j) smoothed[c][j] = load(kept.state + (k * n + j) * p + a, left, whole);
        smooth(kept.covariance + k * n * n, rho[c], smoothed[c]);
      }
    });
    of.variance[k] = -total(by_variance);
    for (int j = 0; j < PAD; j += BLOCK) {
      Vec sum[BLOCK] = {};
      for (int64_t c = 0; c < m; ++c)
        for (int b = 0; b < BLOCK; ++b) sum[b] += w[c] * smoothed[c][j + b];
      for (int b = 0; b < BLOCK && j + b < n; ++b) of.observation[k * n + j + b] = -2 * total(sum[b]);
    }
    Real* by_noise = of.noise + k * n * n;
    if (fixed[k])
      std::fill_n(by_noise, n * n, 0);
    else
      products(m, rho.get(), rho_weighed.get(), true, -1, by_noise);
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < i; ++j) by_noise[j * n + i] = by_noise[i * n + j];
    if (k + 1 < count && fixed[k + 1])
      std::fill_n(of.transition + (k + 1) * n * n, n * n, 0);
    else if (k + 1 < count)
      products(m, before_step.get(), smoothed.get(), false, -2, of.transition + (k + 1) * n * n);
    std::copy_n(&rho_weighed[0][0], m * PAD, &before_step[0][0]);
    if (still) continue;
    const Sparse<n> F(steps.transition + k * n * n);
    for (int64_t c = 0; c < m; ++c) {
      States stepped = {}, stepped_weighed = {};
      F.go([&](int i, int l, Real f) {
        stepped[l] += f * rho[c][i];
        stepped_weighed[l] += f * rho_weighed[c][i];
      });
      std::copy_n(stepped, PAD, rho[c]);
      std::copy_n(stepped_weighed, PAD, rho_weighed[c]);
    }
  }
  for (int64_t c = 0; c < m; ++c) {
    std::fill_n(smoothed[c], PAD, Vec{});
    smooth(initial, rho[c], smoothed[c]);
  }
  products(m, rho.get(), rho_weighed.get(), false, -1, of.initial);
  products(m, before_step.get(), smoothed.get(), false, -2, of.transition);
}

void pull(int64_t count, int64_t p, Steps steps, const Real* initial, const bool* fixed, const Real* rows,
          const Real* weighed, Kept<const Real> kept, Cotangents of) {
  if constexpr (WIDE) return pull_wide(count, p, steps, initial, fixed, rows, weighed, kept, of);
  // Of a panel, from the step that follows the reading: Fᵀρ, FᵀρḠ, and ρḠ itself.
  struct Later {
    Vec rho[n], weighed[n], before_step[n];
  };
  const int64_t m = panels(p);
  const std::unique_ptr<Later[]> work(new Later[m]());
  for (int64_t k = count - 1; k >= 0; --k) {
    const Real *F = steps.transition + k * n * n, *H = steps.observation + k * n;
    const Real *P = kept.covariance + k * n * n, *gain = kept.gain + k * n, per_std = kept.per_std[k];
    Vec by_variance = {}, by_observation[n] = {}, by_noise[n][n] = {}, by_transition[n][n] = {};
    for_panels(p, [&](int64_t c, int64_t left, auto whole) {
      Later& later = work[c];
      const int64_t a = c * LANES;
      Vec u = per_std * load(rows + k * p + a, left, whole), w = per_std * load(weighed + k * p + a, left, whole);
      for (int i = 0; i < n; ++i) {
        u -= gain[i] * later.rho[i];
        w -= gain[i] * later.weighed[i];
      }
      store(of.columns + k * p + a, left, w + w, whole);
      by_variance += u * w;
      Vec rho[n], weighed_rho[n];
      for (int i = 0; i < n; ++i) {
        rho[i] = later.rho[i] + H[i] * u;
        weighed_rho[i] = later.weighed[i] + H[i] * w;
        for (int j = 0; j <= i; ++j) by_noise[i][j] += rho[i] * weighed_rho[j];
      }
      for (int j = 0; j < n; ++j) {
        Vec smoothed = load(kept.state + (k * n + j) * p + a, left, whole);
        for (int l = 0; l < n; ++l) smoothed += P[j * n + l] * rho[l];
        by_observation[j] += w * smoothed;
        for (int i = 0; i < n; ++i) by_transition[i][j] += later.before_step[i] * smoothed;
      }
      for (int i = 0; i < n; ++i) {
        later.before_step[i] = weighed_rho[i];
        later.rho[i] = F[i] * rho[0];
        later.weighed[i] = F[i] * weighed_rho[0];
        for (int j = 1; j < n; ++j) {
          later.rho[i] += F[j * n + i] * rho[j];
          later.weighed[i] += F[j * n + i] * weighed_rho[j];
        }
      }
    });
    of.variance[k] = -total(by_variance);
    for (int i = 0; i < n; ++i) {
      of.observation[k * n + i] = -2 * total(by_observation[i]);
      for (int j = 0; j <= i; ++j)
        of.noise[(k * n + i) * n + j] = of.noise[(k * n + j) * n + i] = -total(by_noise[i][j]);
      if (k + 1 < count)
        for (int j = 0; j < n; ++j) of.transition[((k + 1) * n + i) * n + j] = -2 * total(by_transition[i][j]);
    }
  }
  // Before the first step the states are zero, and what all columns say of them is P₀ρ.
  Vec by_start[n][n] = {}, by_transition[n][n] = {};
  for (int64_t c = 0; c < m; ++c)
    for (int j = 0; j < n; ++j) {
      Vec smoothed = {};
      for (int l = 0; l < n; ++l) smoothed += initial[j * n + l] * work[c].rho[l];
      for (int i = 0; i < n; ++i) {
        by_start[i][j] += work[c].rho[i] * work[c].weighed[j];
        by_transition[i][j] += work[c].before_step[i] * smoothed;
      }
    }
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j) {
      of.initial[i * n + j] = -total(by_start[i][j]);
      of.transition[i * n + j] = -2 * total(by_transition[i][j]);
    }
}

// --- arguments and results in the order of `native.py`, with any number of leading axes -------------------------------

struct Call : Frame {
  const int64_t problems, count, p;

  Call(XLA_FFI_CallFrame* frame, size_t columns)
      : Frame(frame), problems(leading(columns, 2)), count(length(columns, 1)), p(length(columns, 0)) {}

  Steps steps(int64_t b) const {
    return {in(0, b, count * n * n), in(1, b, count * n * n), in(2, b, count * n), in(3, b, count),
            in<bool>(4, b, count)};
  }
};

void filter_all(XLA_FFI_CallFrame* frame) {
  const Call call(frame, 7);
  const int64_t count = call.count, p = call.p;
  for (int64_t b = 0; b < call.problems; ++b) {
    Kept<Real> kept;
    const bool keep = call.results.size > 3;
    if (keep)
      kept = {call.out(3, b, count * n * p), call.out(4, b, count * n * n), call.out(5, b, count * n),
              call.out(6, b, count)};
    filter(count, p, call.steps(b), call.in(5, b, n * p), call.in(6, b, n * n), call.in(7, b, count * p),
           call.out(0, b, count * p), call.out(1, b, n * p), call.out(2, b, n * n), keep ? &kept : nullptr);
  }
}

void pull_all(XLA_FFI_CallFrame* frame) {
  const Call call(frame, 7);
  const int64_t count = call.count, p = call.p;
  for (int64_t b = 0; b < call.problems; ++b)
    pull(count, p, call.steps(b), call.in(5, b, n * n), call.in<bool>(6, b, count), call.in(7, b, count * p),
         call.in(8, b, count * p),
         {call.in(9, b, count * n * p), call.in(10, b, count * n * n), call.in(11, b, count * n),
          call.in(12, b, count)},
         {call.out(0, b, count * n * n), call.out(1, b, count * n * n), call.out(2, b, count * n),
          call.out(3, b, count), call.out(4, b, n * n), call.out(5, b, count * p)});
}

}  // namespace

extern "C" XLA_FFI_Error* gradcal_filter(XLA_FFI_CallFrame* frame) { return answered(frame, filter_all); }
extern "C" XLA_FFI_Error* gradcal_pull(XLA_FFI_CallFrame* frame) { return answered(frame, pull_all); }

// --- how NumPy's arrays come, one problem at a time -------------------------------------------------------------------

extern "C" void gradcal_filter_plain(int64_t count, int64_t p, const Real* transition, const Real* noise,
                                     const Real* observation, const Real* variance, const bool* used, const Real* mean,
                                     const Real* covariance, const Real* columns, Real* rows, Real* mean_after,
                                     Real* covariance_after) {
  filter(count, p, {transition, noise, observation, variance, used}, mean, covariance, columns, rows, mean_after,
         covariance_after, nullptr);
}
