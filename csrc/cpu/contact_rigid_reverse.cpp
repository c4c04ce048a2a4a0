#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cmath>

#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;
using rigid::Body, rigid::Vector;

namespace {

struct Mass {
  double whole;
  Vector center;
};

template <class T>
Mass mass_of(const Body<T>& b) {
  double whole = 0;
  Vector sum{};
  for (int32_t i = 0; i < b.size(); ++i) {
    const double m = b.mass(b.vertex(i));
    whole += m, sum += m * b.position(b.vertex(i));
  }
  return {whole, 0 < whole ? (1 / whole) * sum : Vector{}};
}

// What the center of mass has been sent, c_bar, goes on to positions and masses.
template <class T>
void send_center(const Body<T>& b, const Mass& mass, const Vector& c_bar, T* x, T* masses) {
  if (!(0 < mass.whole)) return;
  const Vector common = (1 / mass.whole) * c_bar;
  for (int32_t i = 0; i < b.size(); ++i) {
    const int32_t v = b.vertex(i);
    rigid::add_to(x + 3 * b.row(v), b.mass(v) * common);
    masses[b.row(v)] += T(dot(b.position(v) - mass.center, common));
  }
}

// Calls f(body, its place) for all bodies of all scenes; those of one scene one after another.
template <class T, class F>
void each_body(const RigidInputs<T>& in, const F& f) {
  torch::stable::parallel_for(0, in.scene.scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t scene = begin; scene < end; ++scene) {
      for (int32_t k = 0; k < in.bodies(); ++k) f(Body<T>{in.scene, scene, k}, scene * in.bodies() + k);
    }
  });
}

// The adjoints of an energy's data that a vertex sends, added to those of its scene.
template <class T>
void add_data(const Body<T>& b, int32_t v, const Vector& P, const Vector& Q, T* scene_data) {
  const StepParameters<double> none{b.in.time_step, 0, 1, -1, 0, 1, 1, false};
  const VertexState<double> s = b.state(v, b.position(v));
  b.energies(v, [&](auto energy, int e, const double* data, int count) {
    using E = decltype(energy);
    T* to = scene_data + b.in.data_start[e] + (E::per_vertex ? int64_t{v} * count : 0);
    for (int j = 0; j < count; j += E::stride) {
      double bar[E::stride];
      record_vjp<E>(s, data + j, P, Q, zero3<double>(), none, 0.0, 0.0, NoFrame<double>{}, bar);
      for (int c = 0; c < E::stride; ++c) to[j + c] += T(bar[c]);
    }
  });
}

}  // namespace

template <class T>
void rigid_end_backward(const RigidInputs<T>& in, const double* motions, const double* shares, const T* end_bar,
                        double* motion_bar, T* x, T* mass) {
  each_body(in, [&](const Body<T>& b, int64_t place) {
    const Mass own = mass_of(b);
    const double *motion = motions + kUnknowns * place, share = shares[place];
    const Vector w = share * Vector{motion[0], motion[1], motion[2]};
    const rigid::Angles angles(w);
    Vector sum{}, c_bar{};
    rigid::Matrix turning = 0.0 * rigid::identity();
    for (int32_t i = 0; i < b.size(); ++i) {
      const int32_t v = b.vertex(i);
      const Vector g = Body<T>::at(end_bar + 3 * b.row(v)), r = b.position(v) - own.center;
      const Vector arm = arm_adjoint(w, angles, g);
      rigid::put(x + 3 * b.row(v), g + arm);
      c_bar -= arm, sum += g;
      turning = turning + rigid::outer(g, r);
    }
    motion_adjoint(motion, share, sum, turning, motion_bar + kUnknowns * place);
    send_center(b, own, c_bar, x, mass);
  });
}

template <class T>
void rigid_virtual_motions(const RigidInputs<T>& in, const double* motion, double* solution, T* p, T* q) {
  each_body(in, [&](const Body<T>& b, int64_t place) {
    double* l = solution + kUnknowns * place;
    // of a matrix that was not positive definite no motion came, and nothing goes back through it
    const bool moves = in.free[b.body] && std::all_of(l, l + kUnknowns, [](double a) { return std::isfinite(a); });
    if (!moves) std::fill_n(l, kUnknowns, 0.0);
    const Mass own = mass_of(b);
    for (int32_t i = 0; i < b.size(); ++i) {
      const int32_t v = b.vertex(i);
      const int64_t to = 3 * (b.scene * in.gate.corners + v);
      const Vector r = b.position(v) - own.center;
      rigid::put(p + to, moved_by(l, r));
      rigid::put(q + to, moved_by(motion + kUnknowns * place, r));
    }
  });
}

template <class T>
void rigid_vertices_backward(const RigidInputs<T>& in, const double* motion, const double* solution,
                             const VirtualMotions<T>& sent, const RigidVertexBars<T>& out) {
  each_body(in, [&](const Body<T>& b, int64_t place) {
    const double *p = solution + kUnknowns * place, *q = motion + kUnknowns * place;
    if (std::all_of(p, p + kUnknowns, [](double a) { return a == 0; })) return;
    const Mass own = mass_of(b);
    Vector c_bar{};
    for (int32_t i = 0; i < b.size(); ++i) {
      const int32_t v = b.vertex(i);
      const int64_t row = b.row(v), corner = 3 * (b.scene * in.gate.corners + v);
      const Vector r = b.position(v) - own.center;
      T* floor_lag = out.floor_lag ? out.floor_lag + row * in.planes * kFloorLag : nullptr;
      const VertexAdjoint bar =
          vertex_adjoint(in, b, v, r, p, q, Body<T>::at(sent.p + corner), Body<T>::at(sent.q + corner), floor_lag);
      rigid::put(out.x + 3 * row, bar.x + bar.arm);
      rigid::put(out.x_prev + 3 * row, bar.x_prev);
      rigid::put(out.y + 3 * row, bar.y);
      out.mass[row] = T(bar.mass);
      c_bar -= bar.arm;
      if (out.data) add_data(b, v, moved_by(p, r), moved_by(q, r), out.data + b.scene * out.data_size);
    }
    send_center(b, own, c_bar, out.x, out.mass);
  });
}

#define DIFFVBD_INSTANTIATE(T)                                                                                         \
  template void rigid_end_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*, double*, T*, T*); \
  template void rigid_virtual_motions<T>(const RigidInputs<T>&, const double*, double*, T*, T*);                       \
  template void rigid_vertices_backward<T>(const RigidInputs<T>&, const double*, const double*,                        \
                                           const VirtualMotions<T>&, const RigidVertexBars<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
