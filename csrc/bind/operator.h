// One entry for each operator: DIFFVBD_OPERATOR(returns, name, parameters) { body }. Its schema follows from the text
// of its parameters, and each backend that compiles the entry registers it.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace diffvbd {

using torch::stable::Tensor;

// The types of parameters, as entries spell them.
using In = const Tensor&;
using Ints = const std::vector<int64_t>&;
using Numbers = const std::vector<double>&;
using Flags = const std::vector<bool>&;

template <size_t... I>
auto tuple_of_tensors(std::index_sequence<I...>) -> std::tuple<decltype((void)I, Tensor())...>;
// So many tensors.
template <size_t n>
using Out = decltype(tuple_of_tensors(std::make_index_sequence<n>()));

inline constexpr size_t returns(const Tensor*) { return 1; }
template <class... T>
constexpr size_t returns(const std::tuple<T...>*) {
  return sizeof...(T);
}

// "In x, double h" -> "name(Tensor x, float h) -> (Tensor, Tensor)"
inline std::string schema_of(const char* name, const std::string& parameters, size_t tensors) {
  const std::pair<const char*, const char*> types[] = {
      {"In", "Tensor"},   {"Ints", "int[]"},   {"Numbers", "float[]"}, {"Flags", "bool[]"},
      {"int64_t", "int"}, {"double", "float"}, {"bool", "bool"},
  };
  std::string out = std::string(name) + "(";
  for (size_t begin = 0; begin < parameters.size();) {
    begin = parameters.find_first_not_of(" ,", begin);
    const size_t space = parameters.find(' ', begin), end = std::min(parameters.find(',', begin), parameters.size());
    const std::string type = parameters.substr(begin, space - begin);
    const char* known = nullptr;
    for (const auto& [own, torch] : types) known = type == own ? torch : known;
    if (!known) throw std::logic_error("diffvbd: " + std::string(name) + " has a parameter of type " + type);
    out += (out.back() == '(' ? "" : ", ") + (known + parameters.substr(space, end - space));
    begin = end;
  }
  out += ") -> (";
  for (size_t i = 0; i < tensors; ++i) out += i > 0 ? ", Tensor" : "Tensor";
  return out + ")";
}

}  // namespace diffvbd

#define DIFFVBD_TEXT(...) DIFFVBD_TEXT_(__VA_ARGS__)
#define DIFFVBD_TEXT_(...) #__VA_ARGS__

// A generated law has objects of its own, in which diffvbd is another name, of namespace and library (diffvbd/laws).
#define DIFFVBD_FRAGMENT(library, m) STABLE_TORCH_LIBRARY_FRAGMENT(library, m)
#define DIFFVBD_IMPL(library, backend, m) STABLE_TORCH_LIBRARY_IMPL(library, backend, m)

// The object of the CPU, which is always there, defines what the operators of all backends are.
#ifdef USE_CUDA
#define DIFFVBD_BACKEND CUDA
#define DIFFVBD_SCHEMA(Returns, name, ...)
#else
#define DIFFVBD_BACKEND CPU
#define DIFFVBD_SCHEMA(Returns, name, ...)                                                                           \
  DIFFVBD_FRAGMENT(diffvbd, m) {                                                                                     \
    m.def(::diffvbd::schema_of(#name, DIFFVBD_TEXT(__VA_ARGS__), ::diffvbd::returns(static_cast<Returns*>(nullptr))) \
              .c_str());                                                                                             \
  }
#endif

#define DIFFVBD_OPERATOR(Returns, name, ...)    \
  static Returns name##_operator(__VA_ARGS__);  \
  DIFFVBD_SCHEMA(Returns, name, __VA_ARGS__)    \
  DIFFVBD_IMPLEMENTATION(DIFFVBD_BACKEND, name) \
  static Returns name##_operator(__VA_ARGS__)
#define DIFFVBD_IMPLEMENTATION(backend, name) DIFFVBD_IMPLEMENTATION_(backend, name)
#define DIFFVBD_IMPLEMENTATION_(backend, name) \
  DIFFVBD_IMPL(diffvbd, backend, m) { m.impl(#name, TORCH_BOX(&name##_operator)); }
