// The sums of `sums.py` and their derivatives in machine code: the polynomials of a panel of nodes never leave the
// registers. Arrays are as there, row-major, pieces one after the other.

#include "panels.h"

namespace {

// No more polynomials of either variable.
constexpr int MOST = 16;

// Legendre polynomials of a panel, and, of those, the derivatives.
void polynomials(Vec x, int64_t count, Vec* values) {
  values[0] = Vec{} + 1;
  if (count > 1) values[1] = x;
  for (int64_t a = 2; a < count; ++a)
    values[a] = (Real(2 * a - 1) * x * values[a - 1] - Real(a - 1) * values[a - 2]) * (Real(1) / a);
}

void slopes(const Vec* values, int64_t count, Vec* of) {
  of[0] = Vec{};
  if (count > 1) of[1] = Vec{} + 1;
  for (int64_t a = 2; a < count; ++a) of[a] = of[a - 2] + Real(2 * a - 1) * values[a - 1];
}

// x, y and weight of the nodes of `pieces`, `nodes` each; so many polynomials of x and of y.
struct Sums {
  int64_t pieces, nodes, first, second;
  const Real *x, *y, *weight;
};

void sums(const Sums& s, Real* out) {
  for (int64_t k = 0; k < s.pieces; ++k, out += s.first * s.second) {
    Vec sum[MOST * MOST] = {}, t[MOST], u[MOST];
    const Real *x = s.x + k * s.nodes, *y = s.y + k * s.nodes, *weight = s.weight + k * s.nodes;
    for_panels(s.nodes, [&](int64_t c, int64_t left, auto whole) {
      polynomials(load(x + c * LANES, left, whole), s.first, t);
      polynomials(load(y + c * LANES, left, whole), s.second, u);
      const Vec w = load(weight + c * LANES, left, whole);
      for (int64_t b = 0; b < s.second; ++b) u[b] *= w;
      for (int64_t a = 0; a < s.first; ++a)
        for (int64_t b = 0; b < s.second; ++b) sum[a * s.second + b] += t[a] * u[b];
    });
    for (int64_t i = 0; i < s.first * s.second; ++i) out[i] = total(sum[i]);
  }
}

// Cotangents of x, y and weight for `of_sums`, that of the sums.
void pull(const Sums& s, const Real* of_sums, Real* of_x, Real* of_y, Real* of_weight) {
  for (int64_t k = 0; k < s.pieces; ++k, of_sums += s.first * s.second)
    for_panels(s.nodes, [&](int64_t c, int64_t left, auto whole) {
      const int64_t at = k * s.nodes + c * LANES;
      const Vec w = load(s.weight + at, left, whole);
      Vec t[MOST], u[MOST], t_slopes[MOST], u_slopes[MOST], by_weight = {}, by_x = {}, by_y = {};
      polynomials(load(s.x + at, left, whole), s.first, t);
      polynomials(load(s.y + at, left, whole), s.second, u);
      slopes(t, s.first, t_slopes);
      slopes(u, s.second, u_slopes);
      for (int64_t a = 0; a < s.first; ++a) {
        Vec across = {}, steep = {};
        for (int64_t b = 0; b < s.second; ++b) {
          across += of_sums[a * s.second + b] * u[b];
          steep += of_sums[a * s.second + b] * u_slopes[b];
        }
        by_weight += t[a] * across;
        by_x += t_slopes[a] * across;
        by_y += t[a] * steep;
      }
      store(of_x + at, left, w * by_x, whole);
      store(of_y + at, left, w * by_y, whole);
      store(of_weight + at, left, by_weight, whole);
    });
}

// Sums of all rows up to each one, from the first on or, `back`, from the last.
void running(int64_t count, int64_t columns, bool back, const Real* values, Real* out) {
  const int64_t step = back ? -columns : columns, begin = back ? (count - 1) * columns : 0;
  std::memcpy(out + begin, values + begin, columns * sizeof(Real));
  for (int64_t k = 1; k < count; ++k) {
    const int64_t at = begin + k * step;
    for (int64_t c = 0; c < columns; ++c) out[at + c] = out[at - step + c] + values[at + c];
  }
}

// --- arguments and results in the order of `sums.py`, with any number of leading axes -----------------------------

// `sums`: an array of them, whose last axes are the numbers of polynomials.
Sums read(const Frame& frame, const void* sums) {
  const auto* shape = static_cast<const XLA_FFI_Buffer*>(sums);
  return {frame.leading(0, 1), frame.length(0, 0), shape->dims[shape->rank - 2], shape->dims[shape->rank - 1],
          frame.in(0, 0, 0), frame.in(1, 0, 0), frame.in(2, 0, 0)};
}

void run_all(XLA_FFI_CallFrame* frame, bool back) {
  const Frame call(frame);
  const int64_t count = call.length(0, 1), columns = call.length(0, 0);
  for (int64_t b = 0; b < call.leading(0, 2); ++b)
    running(count, columns, back, call.in(0, b, count * columns), call.out(0, b, count * columns));
}

}  // namespace

extern "C" XLA_FFI_Error* gradcal_sums(XLA_FFI_CallFrame* frame) {
  return answered(frame, [](XLA_FFI_CallFrame* frame) {
    const Frame call(frame);
    sums(read(call, call.results.rets[0]), call.out(0, 0, 0));
  });
}

extern "C" XLA_FFI_Error* gradcal_sums_pull(XLA_FFI_CallFrame* frame) {
  return answered(frame, [](XLA_FFI_CallFrame* frame) {
    const Frame call(frame);
    pull(read(call, call.arguments.args[3]), call.in(3, 0, 0), call.out(0, 0, 0), call.out(1, 0, 0), call.out(2, 0, 0));
  });
}

extern "C" XLA_FFI_Error* gradcal_running(XLA_FFI_CallFrame* frame) {
  return answered(frame, [](XLA_FFI_CallFrame* frame) { run_all(frame, false); });
}

extern "C" XLA_FFI_Error* gradcal_running_back(XLA_FFI_CallFrame* frame) {
  return answered(frame, [](XLA_FFI_CallFrame* frame) { run_all(frame, true); });
}
