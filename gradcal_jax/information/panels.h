// Vector registers, and how JAX calls: what all sources of machine code share. `compiled.py` says the precision (REAL).

#include <cstdint>
#include <cstring>
#include <type_traits>

// XLA's plain C interface: its C++ headers take the compiler four times as long as everything here.
#include "xla/ffi/api/c_api.h"

namespace {

using Real = REAL;

// Numbers go side by side through a vector register, a panel of LANES at a time. The register is the target's: emulated
// with narrower ones, wide panels cost several times what they should.
#ifndef WIDTH
#if defined(__AVX512F__)
#define WIDTH 64
#elif defined(__AVX__)
#define WIDTH 32
#else
#define WIDTH 16
#endif
#endif
constexpr int64_t LANES = WIDTH / sizeof(Real);
using Vec = Real __attribute__((vector_size(WIDTH)));

int64_t panels(int64_t columns) { return (columns + LANES - 1) / LANES; }

// A panel, `whole` or the last one, of which only `left` columns are there; the others are zero. Copies of a known size
// are one instruction, wherever the numbers lie.
template <typename Whole>
Vec load(const Real* from, int64_t left, Whole whole) {
  Vec panel = {};
  std::memcpy(&panel, from, whole ? sizeof panel : left * sizeof(Real));
  return panel;
}

template <typename Whole>
void store(Real* to, int64_t left, Vec panel, Whole whole) {
  std::memcpy(to, &panel, whole ? sizeof panel : left * sizeof(Real));
}

// `each(panel, how many of its columns are there, whether that is all)`: what is known to be whole is compiled apart.
template <typename Each>
void for_panels(int64_t p, Each each) {
  const int64_t whole = p / LANES;
  for (int64_t c = 0; c < whole; ++c) each(c, LANES, std::true_type{});
  if (whole < panels(p)) each(whole, p - whole * LANES, std::false_type{});
}

Real total(Vec panel) {
  Real lane[LANES];
  std::memcpy(lane, &panel, sizeof panel);
  for (int half = LANES / 2; half; half /= 2)
    for (int a = 0; a < half; ++a) lane[a] += lane[a + half];
  return lane[0];
}

// --- how JAX calls it -------------------------------------------------------------------------------------------------

struct Frame {
  const XLA_FFI_Args& arguments;
  const XLA_FFI_Rets& results;

  explicit Frame(XLA_FFI_CallFrame* frame) : arguments(frame->args), results(frame->rets) {}

  const XLA_FFI_Buffer* shape(size_t index) const { return static_cast<XLA_FFI_Buffer*>(arguments.args[index]); }
  // Length of an argument along an axis, counted from the last one, and the product of all but the last `inner`.
  int64_t length(size_t index, int64_t from_last) const { return shape(index)->dims[shape(index)->rank - 1 - from_last]; }
  int64_t leading(size_t index, int64_t inner) const {
    const auto* shape = this->shape(index);
    int64_t count = 1;
    for (int64_t i = 0; i + inner < shape->rank; ++i) count *= shape->dims[i];
    return count;
  }
  // Argument or result `index` of problem `which`, each problem's of `size` numbers.
  template <typename T = Real>
  const T* in(size_t index, int64_t which, int64_t size) const {
    return static_cast<const T*>(static_cast<const XLA_FFI_Buffer*>(arguments.args[index])->data) + which * size;
  }
  Real* out(size_t index, int64_t which, int64_t size) const {
    return static_cast<Real*>(static_cast<const XLA_FFI_Buffer*>(results.rets[index])->data) + which * size;
  }
};

// Before it calls, XLA asks which version of its interface this was compiled for.
XLA_FFI_Error* answered(XLA_FFI_CallFrame* frame, void (*compute)(XLA_FFI_CallFrame*)) {
  for (auto* extension = frame->extension_start; extension; extension = extension->next)
    if (extension->type == XLA_FFI_Extension_Metadata) {
      auto* metadata = reinterpret_cast<XLA_FFI_Metadata_Extension*>(extension)->metadata;
      metadata->api_version.major_version = XLA_FFI_API_MAJOR;
      metadata->api_version.minor_version = XLA_FFI_API_MINOR;
      metadata->traits = 0;
      return nullptr;
    }
  if (frame->stage == XLA_FFI_ExecutionStage_EXECUTE) compute(frame);
  return nullptr;
}

}  // namespace
