// How the potential of a body changes along a correction, and how far the body goes. Loops and sums belong to a Team
// (rigid/body.h).
#pragma once

#include "../rigid/body.h"
#include "length.h"
#include "views.h"

namespace diffvbd::coarse {

using rigid::Vector;

// One body of one scene. In: StepInputs of a backend; x, way: rows of its positions.
template <class T, class In>
struct Line {
  const In& in;
  const Inputs<T>& c;
  const int64_t* data_start;  // of each energy among the data of a scene
  int64_t scene;
  int32_t body;
  const T *x, *way;

  DIFFVBD_FN int32_t size() const { return c.plan.list_ptr[body + 1] - c.plan.list_ptr[body]; }
  DIFFVBD_FN int32_t vertex(int32_t i) const { return c.plan.list[c.plan.list_ptr[body] + i]; }
  DIFFVBD_FN int64_t row(int32_t i) const { return int64_t{kRow} * c.plan.list_position[c.plan.list_ptr[body] + i]; }
  DIFFVBD_FN static Vector at(const T* a) { return {double(a[0]), double(a[1]), double(a[2])}; }

  // What vertex i adds to the slope of the inertial part of the potential.
  DIFFVBD_FN double inertia(int32_t i) const {
    const int64_t v = vertex(i);
    const double mass = in.mass.data[scene * in.mass.scene + v];
    return mass * dot(at(x + row(i)) - at(in.y.data + scene * in.y.scene + 3 * v), at(way + row(i)));
  }

  DIFFVBD_FN VertexState<double> state(int32_t i) const {
    const int64_t v = vertex(i);
    VertexState<double> out{at(x + row(i)),
                            at(in.x_prev.data + scene * in.x_prev.scene + 3 * v),
                            {0, 0, 0},
                            double(in.parameters.time_step)};
    if (in.origin.data) out.origin = at(in.origin.data + scene * in.origin.scene + 3 * v);
    return out;
  }
  // calls f(energy, its data for vertex i, their count) for the energies that are present
  template <class F>
  DIFFVBD_FN void each_energy(int32_t i, F&& f) const {
    rigid::each_energy(
        [&](auto energy, int k) {
          const int count = in.data_count[k];
          if (count == 0) return;
          const T* own = in.data.data + scene * in.data.scene + data_start[k] +
                         (decltype(energy)::per_vertex ? int64_t{vertex(i)} * count : 0);
          double data[kMaxEnergyData];
          for (int d = 0; d < count; ++d) data[d] = own[d];
          f(energy, data, count);
        },
        VertexEnergies{});
  }

  // By how much the energies of vertex i alone rise: infinite where one of them does not admit the motion. Adds their
  // sizes to `size`.
  DIFFVBD_FN double energies(int32_t i, double s, double& size) const {
    const VertexState<double> before = state(i);
    VertexState<double> after = before;
    after.x += s * at(way + row(i));
    double rise = 0;
    bool admitted = true;
    each_energy(i, [&](auto energy, const double* data, int count) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        admitted = admitted && E::template admits<T>(after, before.x, data, count, rigid::kLeastShare);
        rise += E::change(before, s * at(way + row(i)), data, count, size);
      } else {
        const double now = E::value(before, data, count), then = E::value(after, data, count);
        rise += then - now;
        size += std::abs(now) + std::abs(then);
      }
    });
    return admitted ? rise : std::numeric_limits<double>::infinity();
  }

  // What they add to the block of vertex i.
  DIFFVBD_FN Sym3<double> block(int32_t i) const {
    const VertexState<double> now = state(i);
    Vector g{};
    Sym3<double> H{};
    each_energy(i,
                [&](auto energy, const double* data, int count) { decltype(energy)::block(now, data, count, g, H); });
    return H;
  }
};

DIFFVBD_FN bool acts(const Sym3<double>& H) { return H.xx + H.yy + H.zz > 0; }  // of a semidefinite block

// The length of a correction a, where `restricted` is what it was solved from; tets [parts, kDegree]: coefficients of
// the tets' energy along it, by part.
template <class T, class In, class Team>
DIFFVBD_FN double decide(const Line<T, In>& line, const T* a, const T* restricted, const double* tets,
                         const Team& team) {
  const Plan& p = line.c.plan;
  const int32_t first = p.function_ptr[line.body], count = p.function_ptr[line.body + 1] - first;
  double slope[1], inertial[1], inertia[1];  // the second: a . (P' M P) a
  team.template sum<1>(3 * count, slope, [&](int32_t i, double* out) {
    out[0] -= double(a[3 * first + i]) * double(restricted[3 * first + i]);
  });
  const T* mass = line.c.mass.data + line.scene * line.c.mass.scene + p.mass_ptr[line.body];
  team.template sum<1>(count * count, inertial, [&](int32_t cell, double* out) {
    const T *one = a + 3 * (first + cell / count), *two = a + 3 * (first + cell % count);
    out[0] += double(mass[cell]) * dot(line.at(one), line.at(two));
  });
  Change change{};
  team.template sum<kDegree>(p.part_ptr[line.body + 1] - p.part_ptr[line.body], change.c,
                             [&](int32_t part, double* out) {
                               const double* own = tets + (p.part_ptr[line.body] + part) * kDegree;
                               for (int i = 0; i < kDegree; ++i) out[i] += own[i];
                             });
  const double h2 = double(line.in.parameters.time_step) * double(line.in.parameters.time_step);
  for (double& c : change.c) c *= h2;
  change.c[1] += 0.5 * inertial[0];
  bool others = false;
  for (int k = 0; k < kVertexEnergies; ++k) others = others || line.in.data_count[k] > 0;
  if (!others) {
    change.c[0] = slope[0];
    return length<T>(change, slope[0], [](double, double&) { return 0.0; });
  }
  team.template sum<1>(line.size(), inertia, [&](int32_t i, double* out) { out[0] += line.inertia(i); });
  change.c[0] += inertia[0];
  return length<T>(change, slope[0], [&](double s, double& size) {
    double sums[2];
    team.template sum<2>(line.size(), sums, [&](int32_t i, double* out) { out[0] += line.energies(i, s, out[1]); });
    size += sums[1];
    return sums[0];
  });
}

}  // namespace diffvbd::coarse
