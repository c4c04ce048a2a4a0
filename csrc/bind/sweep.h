// From the fields and settings of a sweep to the arrays of its loops: what the backends share.
#pragma once

#include <vector>

#include "arguments.h"
#include "coarse.h"
#include "contact.h"
#include "fields.h"
#include "material.h"

namespace diffvbd {

// What a sweep executes besides its tensors; twin of SweepSettings in diffvbd/ops/fields.py.
struct SweepSettings {
  const std::vector<int64_t>& sizes;
  int64_t energies;
  const std::vector<int64_t>& data_count;
  const std::vector<double>& numbers;
  int64_t sweeps;
  const std::vector<int64_t>& launch;
  const std::vector<int64_t>& coarse;
  int64_t tape_policy;
};

// What sweeps and whole steps have in common. `packed`: scalars of the packed rest shape of a scene.
template <class In, class Fields, class T = typename In::Scalar>
void set_body(In& in, const Fields& f, const Tensor& x, const SweepSettings& q, int64_t vertices, int64_t tets,
              int64_t packed) {
  require(x.dim() == 3 && x.size(1) == vertices && x.size(2) == 3,
          "diffvbd::sweep: expected x of shape [scenes, vertices, 3]");
  constexpr int64_t known = int64_t{1} << (kFirstVertexBit + kVertexEnergies);
  require(q.energies >= 0 && q.energies < known && (q.energies & kElastic) != kElastic,
          "energies: expected a mask of known energies, at most one of them elastic");
  require(q.tape_policy >= kNoTape && q.tape_policy <= kFullTape, "tape_policy: expected 0, 1 or 2");
  const int64_t b = x.size(0);
  in.scenes = b;
  in.energies = static_cast<int>(tets > 0 ? q.energies : q.energies & ~kElastic);
  in.mass = batched<T>("mass", f.mass, x, b, vertices);
  if (in.energies & kElastic) in.rest = batched<T>("rest", f.rest, x, b, packed);
  const auto material = material_of(f);
  for (int m = 0; m < kMaterialScalars; ++m) {  // a scene without an elastic energy may have none
    in.material[m] = in.energies & kElastic ? batched<T>(kMaterialNames[m], *material[m], x, b, tets, 1)
                                            : batched_or_null<T>(kMaterialNames[m], *material[m], x, b, tets, 1);
  }
  in.data_size = energy_data_size(q.data_count, vertices);
  for (int k = 0; k < kVertexEnergies; ++k) {
    in.data_count[k] = static_cast<int>(q.data_count[k]);
    require(!(q.energies >> (kFirstVertexBit + k) & 1) || in.data_count[k] > 0,
            "data_count: expected data of each energy of single vertices");
  }
  in.parameters = step_parameters<T>(q.numbers);
  in.sweeps = count_of(q.sweeps);
  in.tape_policy = static_cast<int>(q.tape_policy);
}

// x: where the sweeps start or, in the reverse, end
template <class In, class T = typename In::Scalar>
void set_fields(In& in, const SweepFields& f, const Tensor& x, const SweepSettings& q, int64_t vertices, int64_t tets,
                int64_t packed) {
  set_body(in, f, x, q, vertices, tets, packed);
  const int64_t b = in.scenes;
  in.x_start = batched<T>("x", x, x, b, 3 * vertices);
  in.x_prev = batched<T>("x_prev", f.x_prev, x, b, 3 * vertices);
  in.y = batched<T>("y", f.y, x, b, 3 * vertices);
  in.origin = batched_or_null<T>("origin", f.origin, x, b, 3 * vertices);
  in.data = batched<T>("energy_data", f.energy_data, x, b, in.data_size);
  if constexpr (kPrevScalars > 0) {
    const bool elastic = (in.energies & kElastic) != 0;
    require(!elastic || f.corners_prev.numel() == kPrevScalars * b * tets,
            "diffvbd::sweep: expected the corners' positions at the start of the step");
    const Batched<const T> all = batched_or_null<T>("corners_prev", f.corners_prev, x, kPrevScalars, b * tets);
    for (int i = 0; elastic && i < kPrevScalars; ++i)
      in.material[kMaterialScalars + i] = {all.data + i * b * tets, tets, 1};
  }
}

inline bool has_contact(const SweepSettings& q, const SweepFields& f) {
  const bool given = f.ptr.numel() > 0;
  require(given == ((q.energies & kContact) != 0),
          "diffvbd::sweep: expected pairs where contact is among the energies");
  return given;
}

// Adjoints of the body; make(shape, zeroed) allocates. `materials`: values of a scene; wants: material, mass, rest.
template <class Bars, class In, class Make>
void make_body_bars(Bars& bars, const In& in, int64_t vertices, int64_t tets, int64_t materials, bool zeroed,
                    const bool (&wants)[3], const Make& make) {
  const auto wanted = [&](bool wish, const std::vector<int64_t>& shape, bool clear) {
    return make(wish ? shape : std::vector<int64_t>{0}, clear);
  };
  const int64_t b = in.scenes;
  const bool clear = zeroed || (in.energies & kElastic) == 0;  // nothing writes what no tet has
  bars.mu = wanted(wants[0], {b, materials}, clear), bars.lam = wanted(wants[0], {b, materials}, clear);
  bars.mass = wanted(wants[1], {b, vertices}, zeroed);
  bars.rest = wanted(wants[2], {b, tets, kRestScalars}, clear);
}
// A wish for what a scene does not have is null, too.
template <class Out, class Bars, class In, class T = typename Out::Scalar>
void set_body_bars(Out& out, const Bars& bars, const In& in) {
  const auto of = [](const Tensor& a) { return a.numel() > 0 ? data<T>(a) : nullptr; };
  if (in.energies & kElastic) {
    const auto material = material_of(bars);
    for (int m = 0; m < kMaterialScalars; ++m) out.material[m] = of(*material[m]);
    out.rest = of(bars.rest);
  }
  out.mass = of(bars.mass);
}

// Adjoints of a sweep, without those of contact. wants: material, mass, rest, energy data, coarse matrix.
template <class In, class Make>
SweepBars make_bars(const Tensor& x, const SweepFields& f, const In& in, int64_t vertices, int64_t tets,
                    int64_t materials, bool zeroed, const std::vector<bool>& wants, const Make& make) {
  require(wants.size() == 5, "diffvbd::sweep_backward: expected 5 wishes");
  const auto none = [&] { return make({0}, false); };
  SweepBars bars{none(), none(), none(), none(), none(), none(), none(), none(),
                 none(), none(), none(), none(), none(), none(), none()};
  const std::vector<int64_t> state{in.scenes, vertices, 3};
  bars.x_start = make(state, false), bars.x_prev = make(state, zeroed), bars.y = make(state, false);
  make_body_bars(bars, in, vertices, tets, materials, zeroed, {wants[0], wants[1], wants[2]}, make);
  bars.corners_prev =
      make(wants[0] && kPrevScalars > 0 ? std::vector<int64_t>{kPrevScalars, in.scenes, tets} : std::vector<int64_t>{0},
           zeroed || (in.energies & kElastic) == 0);
  const bool corrects = wants[4] && f.coarse_plan.numel() > 0;
  bars.coarse_factor =
      make(corrects ? std::vector<int64_t>{in.scenes, f.coarse_factor.numel() / (in.scenes > 0 ? in.scenes : 1)}
                    : std::vector<int64_t>{0},
           true);
  bars.energy_data = make(wants[3] ? std::vector<int64_t>{in.scenes, in.data_size} : std::vector<int64_t>{0}, zeroed);
  return bars;
}
template <class Out, class In, class T = typename Out::Scalar>
void set_bars(Out& out, const SweepBars& bars, const In& in) {
  set_body_bars(out, bars, in);
  if constexpr (kPrevScalars > 0) {
    const bool follows = bars.corners_prev.numel() > 0 && (in.energies & kElastic);
    for (int i = 0; follows && i < kPrevScalars; ++i) {
      out.material[kMaterialScalars + i] = data<T>(bars.corners_prev) + i * bars.corners_prev.numel() / kPrevScalars;
    }
  }
  out.x_start = data<T>(bars.x_start), out.x_prev = data<T>(bars.x_prev), out.y = data<T>(bars.y);
  out.data = bars.energy_data.numel() > 0 ? data<T>(bars.energy_data) : nullptr;
}

// Limits of updates, of no scenes without contact.
template <class In>
std::vector<int64_t> cut_shape(const In& in, int64_t vertices) {
  return {in.contact ? in.scenes : 0, int64_t{in.sweeps}, vertices};
}
// The same in a reverse; null without contact.
template <class In>
const uint8_t* limits_of(const Tensor& cut, const Tensor& x, const In& in, int64_t vertices) {
  if (!in.contact) return nullptr;
  require(is_beside(cut, x, ScalarType::Byte) && cut.numel() == in.scenes * in.sweeps * vertices,
          "diffvbd::sweep_backward: expected cut of the same sweeps");
  return data<const uint8_t>(cut);
}

// Adjoints of contact, and where its passes add up what they find; `lagged` pairs.
template <class T, class Make>
void make_contact_bars(SweepBars& bars, const contact::ContactInputs<T>& in, int64_t scenes, int64_t vertices,
                       int64_t lagged, const Make& make) {
  const int64_t colliders = in.corners - vertices;
  bars.collider = make({scenes, colliders, 3}, true), bars.collider_prev = make({scenes, colliders, 3}, true);
  bars.kappa = make({scenes}, true);
  bars.lag = make({lagged, contact::kLagScalars}, true);
  bars.floor_lag = make({scenes, vertices, in.planes, contact::kFloorLag}, true);
}

}  // namespace diffvbd
