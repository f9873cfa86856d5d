// The filter and its derivative at many sizes, each array of exactly the size that is promised, for a sanitiser.

#include <cstdio>
#include <memory>

#include "filter.cc"

namespace {

std::unique_ptr<Real[]> filled(int64_t count, Real value) {
  std::unique_ptr<Real[]> made(new Real[count]);
  std::fill_n(made.get(), count, value);
  return made;
}

void once(int64_t count, int64_t p) {
  const int64_t square = count * n * n;
  const auto F = filled(square, 0.1), Q = filled(square, 0.1), H = filled(count * n, 1), R = filled(count, 1);
  const auto mean = filled(n * p, 0), start = filled(n * n, 0.1), columns = filled(count * p, 0.3);
  const auto rows = filled(count * p, 0), after = filled(n * p, 0), covariance = filled(n * n, 0);
  const auto states = filled(count * n * p, 0), kept_covariance = filled(square, 0), gain = filled(count * n, 0);
  const auto per_std = filled(count, 0), of_F = filled(square, 0), of_Q = filled(square, 0);
  const auto of_H = filled(count * n, 0), of_R = filled(count, 0), of_start = filled(n * n, 0);
  const auto of_columns = filled(count * p, 0);
  const std::unique_ptr<bool[]> used(new bool[count]);
  const std::unique_ptr<bool[]> fixed(new bool[count]());
  for (int64_t k = 0; k < count; ++k) used[k] = k % 3 != 1;
  // Every other reading without a step, which many states are told.
  for (int64_t k = 1; k < count; k += 2) {
    fixed[k] = true;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) F[(k * n + i) * n + j] = i == j, Q[(k * n + i) * n + j] = 0;
  }
  const Steps steps{F.get(), Q.get(), H.get(), R.get(), used.get()};
  const Kept<Real> kept{states.get(), kept_covariance.get(), gain.get(), per_std.get()};
  for (const Kept<Real>* keep : {static_cast<const Kept<Real>*>(nullptr), &kept})
    filter(count, p, steps, mean.get(), start.get(), columns.get(), rows.get(), after.get(), covariance.get(), keep);
  pull(count, p, steps, start.get(), fixed.get(), rows.get(), columns.get(),
       {states.get(), kept_covariance.get(), gain.get(), per_std.get()},
       {of_F.get(), of_Q.get(), of_H.get(), of_R.get(), of_start.get(), of_columns.get()});
}

}  // namespace

int main() {
  for (int64_t count : {1, 2, 5, 9})
    for (int64_t p = 0; p <= 40; ++p) once(count, p);
  std::puts("all sizes");
}
