// The sums and their derivative at many sizes, each array of exactly the size that is promised, for a sanitiser.

#include <cstdio>
#include <algorithm>
#include <memory>

#include "sums.cc"

namespace {

std::unique_ptr<Real[]> filled(int64_t count, Real value) {
  std::unique_ptr<Real[]> made(new Real[count]);
  std::fill_n(made.get(), count, value);
  return made;
}

void once(int64_t pieces, int64_t nodes, int64_t first, int64_t second) {
  const int64_t count = pieces * nodes, products = pieces * first * second;
  const auto x = filled(count, 0.3), y = filled(count, -0.2), weight = filled(count, 0.1);
  const auto out = filled(products, 0), of_x = filled(count, 0), of_y = filled(count, 0), of_weight = filled(count, 0);
  const Sums all{pieces, nodes, first, second, x.get(), y.get(), weight.get()};
  sums(all, out.get());
  pull(all, out.get(), of_x.get(), of_y.get(), of_weight.get());
  for (bool back : {false, true}) running(pieces, nodes, back, x.get(), of_x.get());
}

}  // namespace

int main() {
  for (int64_t pieces : {1, 2, 5})
    for (int64_t nodes : {1, 3, 4, 8, 13, 15, 16, 33})
      for (int64_t first : {1, 2, 6, 16})
        for (int64_t second : {1, 2, 5, 16}) once(pieces, nodes, first, second);
  std::puts("all sizes");
}
