// The headers of csrc/core and csrc/energies as a Python module, for test_energies.py. Arrays of double go in and out;
// the computation runs in double, in long double, or through Dual<long double>, which is the oracle.
#include <cxxabi.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cmath>
#include <string>
#include <typeinfo>
#include <vector>

namespace diffvbd {
inline long double select(bool condition, long double a, long double b) { return condition ? a : b; }
inline long double square_root(long double a) { return std::sqrt(a); }
inline long double natural_log(long double a) { return std::log(a); }
}  // namespace diffvbd

#include "cpu/lanes.h"
#include "cpu/scene.h"
#include "sweep/vertex.h"

namespace py = pybind11;
using namespace diffvbd;
using Long = long double;
using Values = std::vector<double>;

template <class R>
Vec3<R> vec(const R* a) {
  return {a[0], a[1], a[2]};
}
template <class R>
void put(Values& out, const Vec3<R>& a) {
  for (const R& v : {a.x, a.y, a.z}) out.push_back(static_cast<double>(v));
}
template <class R>
std::vector<R> cast(const Values& in) {
  return std::vector<R>(in.begin(), in.end());
}

// --- elastic: inputs xi xj xk xl (12) mu lam k_ij k_ik k_il c6 (6) | d_raw p (6) h^2 ---------------------------------
constexpr int kElasticInputs = 18;

template <class R>
TetPair<R> pair_of(const R* a) {
  return {vec(a + 3), vec(a + 6), vec(a + 9), {a[14], a[15], a[16], a[17]}, {a[12], a[13]}};
}

// The adjoints of all inputs, in their order.
template <bool exact, class R>
std::vector<R> elastic_adjoint(const std::vector<R>& a) {
  using Law = StableNeoHookean<exact>;
  const TetPair<R> e = pair_of(a.data());
  const Vec3<R> d_raw = vec(&a[18]), p = vec(&a[21]);
  const auto view = Law::view(e, vec(&a[0]), d_raw, p);
  const TetAdjoint<R> bar = Law::block_vjp(e, view, d_raw, p, -a[24]);
  R material[kMaterialScalars], rest[kPairRest];
  Law::material_vjp(e, view, d_raw, p, -a[24], material);
  Law::rest_vjp(e, view, d_raw, p, -a[24], rest);
  std::vector<R> out;
  for (const Vec3<R>& x : {bar.xi, bar.xj, bar.xk, bar.xl}) out.insert(out.end(), {x.x, x.y, x.z});
  out.insert(out.end(), material, material + kMaterialScalars);
  out.insert(out.end(), rest, rest + kPairRest);
  return out;
}

template <class R, bool exact>
Values elastic_vjp(const Values& in) {
  const std::vector<R> all = elastic_adjoint<exact>(cast<R>(in));
  return Values(all.begin(), all.end());
}

// the gradient by x_i without h^2; inputs as above
template <bool exact, class R>
Vec3<R> gradient_of(const R* a) {
  Vec3<R> g = zero3<R>();
  R h_diagonal(0);
  Sym3<R> H = diagonal(R(0));
  StableNeoHookean<exact>::block(pair_of(a), vec(a), g, h_diagonal, H);
  return g;
}
Values elastic_gradient(const Values& a, bool exact) {
  Values out;
  put(out, exact ? gradient_of<true>(a.data()) : gradient_of<false>(a.data()));
  return out;
}

// -h^2 times the gradient of p . (g + H d_raw), by one Dual for each input
template <bool exact>
Values elastic_dual(const Values& in) {
  using D = Dual<Long>;
  const std::vector<Long> a = cast<Long>(in);
  Values out;
  for (int i = 0; i < kElasticInputs; ++i) {
    std::vector<D> b;
    for (const Long& v : a) b.emplace_back(v);
    b[i].derivative = 1;
    Vec3<D> g = zero3<D>();
    D h_diagonal(0);
    Sym3<D> H = diagonal(D(0));
    StableNeoHookean<exact>::block(pair_of(b.data()), vec(&b[0]), g, h_diagonal, H);
    add_diagonal(H, h_diagonal);
    out.push_back(static_cast<double>(-(b[24] * dot(vec(&b[21]), g + H * vec(&b[18]))).derivative));
  }
  return out;
}

// the derivative of the gradient without h^2 along w; inputs as above, with the corners' w (12) for d_raw, p, h^2
template <bool exact, class R>
Values elastic_product(const Values& in) {
  using Law = StableNeoHookean<exact>;
  const std::vector<R> a = cast<R>(in);
  const TetPair<R> e = pair_of(a.data());
  Values out;
  put(out, Law::product(e, Law::view(e, vec(&a[0]), zero3<R>(), zero3<R>()), vec(&a[18]), vec(&a[21]), vec(&a[24]),
                        vec(&a[27])));
  return out;
}
Values elastic_product_dual(const Values& in) {
  using D = Dual<Long>;
  std::vector<D> a;
  for (const Long v : cast<Long>(in)) a.emplace_back(v);
  for (int i = 0; i < 12; ++i) a[i].derivative = a[18 + i].value;
  const Vec3<D> g = gradient_of<true>(a.data());
  Values out;
  put(out, Vec3<Long>{g.x.derivative, g.y.derivative, g.z.derivative});
  return out;
}

// --- the energy of a tet: inputs four corners (12) rest (7) mu lam
// ----------------------------------------------------
template <class R>
R energy_of(const R* a) {
  const Vec3<R> x[4] = {vec(a), vec(a + 3), vec(a + 6), vec(a + 9)};
  return TetLaw::value(x, a + 12, a + 12 + kRestScalars);
}
// its gradient by the corners, by one Dual each
Values energy_gradient(const Values& in) {
  const std::vector<Long> a = cast<Long>(in);
  Values out;
  for (int i = 0; i < 12; ++i) {
    std::vector<Dual<Long>> b;
    for (const Long& v : a) b.emplace_back(v);
    b[i].derivative = 1;
    out.push_back(static_cast<double>(energy_of(b.data()).derivative));
  }
  return out;
}
// its second derivative by the corners, by central differences of the gradient
Values energy_hessian(const Values& in, double step) {
  Values out;
  for (int i = 0; i < 12; ++i) {
    Values up = in, down = in;
    up[i] += step, down[i] -= step;
    const Values g = energy_gradient(up), h = energy_gradient(down);
    for (int j = 0; j < 12; ++j) out.push_back((g[j] - h[j]) / (2 * step));
  }
  return out;
}
// inputs: gradients of four shape functions (12) mu lam; the 12 x 12 stiffness per volume
Values rest_stiffness(const Values& in) {
  Values out(144);
  for (int a = 0; a < 4; ++a) {
    for (int b = 0; b < 4; ++b) {
      Vec3<double> rows[3];
      TetLaw::rest_stiffness(vec(&in[3 * a]), vec(&in[3 * b]), &in[12], rows);
      for (int i = 0; i < 3; ++i) {
        const double row[] = {rows[i].x, rows[i].y, rows[i].z};
        for (int j = 0; j < 3; ++j) out[(3 * a + i) * 12 + 3 * b + j] = row[j];
      }
    }
  }
  return out;
}

// --- energies of one vertex: inputs x x_prev origin p d_raw step (18) h alpha_bar | data -----------------------------
constexpr int kVertexInputs = 20;

template <class R>
VertexState<R> state_of(const std::vector<R>& a) {
  return {vec(&a[0]), vec(&a[3]), vec(&a[6]), a[18]};
}
template <class R>
StepParameters<R> parameters_of(double h, double saturation) {
  return {R(h), R(0), R(1), R(saturation), R(1e-12), R(0.9), true};
}

// x_bar, x_prev_bar (without the filter), data_bar (with it)
template <class E, class R>
Values vertex_vjp(const Values& in) {
  const std::vector<R> a = cast<R>(in);
  const int count = static_cast<int>(a.size()) - kVertexInputs;
  const VertexState<R> s = state_of(a);
  const Vec3<R> p = vec(&a[9]), d_raw = vec(&a[12]);
  Vec3<R> x_bar = zero3<R>(), x_prev_bar = zero3<R>();
  vertex_energy_vjp<E>(s, &a[kVertexInputs], count, p, d_raw, x_bar, x_prev_bar);
  R data_bar[kMaxEnergyData];
  const auto q = parameters_of<R>(in[18], 1);
  Update<R> u{d_raw, vec(&a[15]), R(1), R(1)};
  if constexpr (E::has_filter) u.alpha = E::filter(s, &a[kVertexInputs], count, u.step, q);
  vertex_energy_data_vjp<E>(s, &a[kVertexInputs], count, p, u, q, a[19],
                            [&](int i, const R& value) { data_bar[i] = value; });
  Values out;
  put(out, x_bar), put(out, x_prev_bar);
  for (int i = 0; i < count; ++i) out.push_back(static_cast<double>(data_bar[i]));
  return out;
}

// alpha_bar alpha - p . (g + H d_raw), in long double: what vertex_vjp differentiates
template <class E>
Long vertex_value(const std::vector<Long>& a, bool filtered) {
  const int count = static_cast<int>(a.size()) - kVertexInputs;
  const VertexState<Long> s = state_of(a);
  Vec3<Long> g = zero3<Long>();
  Sym3<Long> H = diagonal(Long(0));
  E::block(s, &a[kVertexInputs], count, g, H);
  Long value = -dot(vec(&a[9]), g + H * vec(&a[12]));
  if constexpr (E::has_filter) {
    const auto q = parameters_of<Long>(static_cast<double>(a[18]), 1);
    if (filtered) value += a[19] * E::filter(s, &a[kVertexInputs], count, vec(&a[15]), q);
  }
  return value;
}
template <class E>
Values vertex_differences(const Values& in, double relative) {
  const std::vector<Long> a = cast<Long>(in);
  Values out;
  for (size_t i = 0; i < a.size(); ++i) {
    const bool data = i >= kVertexInputs;
    if (i >= 6 && !data) continue;
    std::vector<Long> ahead = a, behind = a;
    const Long step = relative * (a[i] != 0 ? std::abs(a[i]) : Long(1));
    ahead[i] += step, behind[i] -= step;
    out.push_back(static_cast<double>((vertex_value<E>(ahead, data) - vertex_value<E>(behind, data)) / (2 * step)));
  }
  return out;
}

// the same adjoints toward x and x_prev by Dual, even where the energy brings a hand-written block_vjp
template <class E>
Values vertex_dual(const Values& in) {
  const std::vector<Long> a = cast<Long>(in);
  const VertexState<Long> s = state_of(a);
  const Vec3<Long> p = vec(&a[9]), d_raw = vec(&a[12]);
  Vec3<Long> x_bar = zero3<Long>(), x_prev_bar = zero3<Long>();
  for (size_t k = kVertexInputs; k < a.size(); k += E::stride) {
    const DualAdjoint<E, Long> adjoint{s, &a[k], p, d_raw};
    adjoint.subtract_from(x_bar, &VertexState<Dual<Long>>::x);
    adjoint.subtract_from(x_prev_bar, &VertexState<Dual<Long>>::x_prev);
  }
  Values out;
  put(out, x_bar), put(out, x_prev_bar);
  return out;
}

// alpha, then alpha_bar d alpha / d(x, step)
template <class R>
Values filter_vjp(const Values& in) {
  const std::vector<R> a = cast<R>(in);
  const int count = static_cast<int>(a.size()) - kVertexInputs;
  const VertexState<R> s = state_of(a);
  const auto q = parameters_of<R>(in[18], 1);
  const R alpha = FloorBarrier::filter(s, &a[kVertexInputs], count, vec(&a[15]), q);
  Vec3<R> x_bar = zero3<R>(), step_bar = zero3<R>();
  FloorBarrier::filter_vjp(s, &a[kVertexInputs], count, vec(&a[15]), q, alpha, a[19], x_bar, step_bar);
  Values out{static_cast<double>(alpha)};
  put(out, x_bar), put(out, step_bar);
  return out;
}
Values filter_dual(const Values& in) {
  using D = Dual<Long>;
  const std::vector<Long> a = cast<Long>(in);
  const int count = static_cast<int>(a.size()) - kVertexInputs;
  const auto q = parameters_of<Long>(in[18], 1);
  Values out;
  for (int i = -1; i < 6; ++i) {
    std::vector<D> b;
    for (const Long& v : a) b.emplace_back(v);
    if (i >= 0) b[i < 3 ? i : 12 + i].derivative = 1;
    const D alpha = FloorBarrier::filter(state_of(b), &b[kVertexInputs], count, vec(&b[15]), q);
    out.push_back(static_cast<double>(i < 0 ? alpha.value : a[19] * alpha.derivative));
  }
  return out;
}

// --- safeguards and the 3x3 solve ------------------------------------------------------------------------------------
template <class R>
Values saturate_vjp_of(const Values& d_raw, const Values& d_bar, double c) {
  Values out;
  put(out, saturate_vjp(vec(cast<R>(d_raw).data()), vec(cast<R>(d_bar).data()), parameters_of<R>(1, c)));
  return out;
}
Values saturate_dual(const Values& d_raw, const Values& d_bar, double c) {
  using D = Dual<Long>;
  Values out;
  for (int i = 0; i < 3; ++i) {
    D d[3] = {D(Long(d_raw[0])), D(Long(d_raw[1])), D(Long(d_raw[2]))};
    d[i].derivative = 1;
    const Vec3<D> bar = constant(vec(cast<Long>(d_bar).data()));
    out.push_back(static_cast<double>(dot(bar, saturate(vec(d), parameters_of<Long>(1, c))).derivative));
  }
  return out;
}
Values saturated(const Values& d_raw, double c) {
  Values out;
  put(out, saturate(vec(d_raw.data()), parameters_of<double>(1, c)));
  return out;
}
Values solve_of(const Values& a, const Values& b, double least) {
  Values out;
  const Sym3<double> matrix{a[0], a[1], a[2], a[3], a[4], a[5]};
  put(out, solve(factor<double>(matrix, least), vec(b.data())));
  return out;
}

// Each lane must run the scalar program: kLanes inputs at once against one by one.
template <bool exact>
bool lanes_are_scalars(const std::vector<Values>& in) {
  using R = Lanes<double>;
  std::vector<R> a(in[0].size());
  for (size_t i = 0; i < a.size(); ++i) {
    for (int l = 0; l < kLanes; ++l) a[i].v[l] = in[l][i];
  }
  const std::vector<R> all = elastic_adjoint<exact>(a);
  for (int l = 0; l < kLanes; ++l) {
    const Values one = elastic_vjp<double, exact>(in[l]);
    for (int i = 0; i < kElasticInputs; ++i) {
      if (all[i].v[l] != one[i]) return false;
    }
  }
  return true;
}

// name -> (bit in a scene's mask, scalars of data, one set for each vertex, step filter)
template <class... E>
py::dict listed(EnergyList<E...>) {
  py::dict out;
  int bit = 1 << kFirstVertexBit;
  const auto add = [&](const char* mangled, int stride, bool per_vertex, bool has_filter) {
    int status = 0;
    char* name = abi::__cxa_demangle(mangled, nullptr, nullptr, &status);
    const std::string full(name);
    std::free(name);
    out[py::str(full.substr(full.rfind(':') + 1))] = py::make_tuple(bit, stride, per_vertex, has_filter);
    bit *= 2;
  };
  (add(typeid(E).name(), E::stride, E::per_vertex, E::has_filter), ...);
  return out;
}

PYBIND11_MODULE(headers, m) {
  m.def("elastic_vjp", [](const Values& a, bool exact, bool extended) {
    if (extended) return exact ? elastic_vjp<Long, true>(a) : elastic_vjp<Long, false>(a);
    return exact ? elastic_vjp<double, true>(a) : elastic_vjp<double, false>(a);
  });
  m.def("elastic_dual",
        [](const Values& a, bool exact) { return exact ? elastic_dual<true>(a) : elastic_dual<false>(a); });
  m.def("elastic_product", [](const Values& a, bool exact, bool extended) {
    if (extended) return exact ? elastic_product<true, Long>(a) : elastic_product<false, Long>(a);
    return exact ? elastic_product<true, double>(a) : elastic_product<false, double>(a);
  });
  m.def("elastic_product_dual", &elastic_product_dual);
  m.def("energy_gradient", &energy_gradient);
  m.def("energy_hessian", &energy_hessian);
  m.def("rest_stiffness", &rest_stiffness);
  m.def("elastic_gradient", &elastic_gradient);
  m.def("floor_vjp", [](const Values& a, bool extended) {
    return extended ? vertex_vjp<FloorBarrier, Long>(a) : vertex_vjp<FloorBarrier, double>(a);
  });
  m.def("floor_dual", &vertex_dual<FloorBarrier>);
  m.def("floor_differences", &vertex_differences<FloorBarrier>);
  m.def("anchor_vjp", &vertex_vjp<Anchor, double>);
  m.def("filter_vjp",
        [](const Values& a, bool extended) { return extended ? filter_vjp<Long>(a) : filter_vjp<double>(a); });
  m.def("filter_dual", &filter_dual);
  m.def("saturate", &saturated);
  m.def("saturate_vjp", [](const Values& d, const Values& bar, double c, bool extended) {
    return extended ? saturate_vjp_of<Long>(d, bar, c) : saturate_vjp_of<double>(d, bar, c);
  });
  m.def("saturate_dual", &saturate_dual);
  m.def("solve", &solve_of);
  m.def("lanes_are_scalars", [](const std::vector<Values>& in, bool exact) {
    return exact ? lanes_are_scalars<true>(in) : lanes_are_scalars<false>(in);
  });
  m.def("vertex_energies", [] { return listed(VertexEnergies{}); });
  m.def("tape_rows", &tape_rows);
  m.def("keeps_positions", &keeps_positions);
  m.def("kept_scalars", &kept_scalars);
  m.def("variant_masks", [] {
    std::vector<std::vector<int>> out(2);  // of all variants, and of those without contact; each must be its own place
    for (int n = 0; n < kEnergySets; ++n) out[0].push_back(energy_index(energy_mask(n)) == n ? energy_mask(n) : -1);
    for (int n = 0; n < kFreeSets; ++n) out[1].push_back(free_index(free_mask(n)) == n ? free_mask(n) : -1);
    return out;
  });
  m.attr("contact") = kContact;
  m.attr("exact_block") = static_cast<int>(kExactBlock);
  m.attr("paper_block") = static_cast<int>(kPaperBlock);
  m.attr("max_energy_data") = kMaxEnergyData;
  m.attr("lanes") = kLanes;
  m.attr("long_double_digits") = std::numeric_limits<Long>::digits;
}
