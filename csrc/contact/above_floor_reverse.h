// What a floor leaves of the ways of all bodies that move as wholes (contact/above_floor.h), and the adjoint. Where
// several vertices or planes decide alike, they share it evenly.
#pragma once

#include "../rigid/body.h"
#include "above_floor.h"

namespace diffvbd::contact {

template <class T>
struct AboveFloorInputs {
  rigid::Inputs<T> scene;  // x, origin and the vertices of all bodies
  const T* way;            // [B, V, 3]  from x
  const T* u;              // [B, bodies, 3]  the part of it that is behind, which the floor lets pass; or null
  Batched<const T> floor;  // [1 | B, planes, 7]
  const bool* held;        // [V]
  int32_t planes;
};

// One body as above_floor() asks for it.
template <class T>
struct DescendingBody {
  const AboveFloorInputs<T>& in;
  const rigid::Body<T>& b;
  Vector u;

  DIFFVBD_FN DescendingBody(const AboveFloorInputs<T>& inputs, const rigid::Body<T>& body)
      : in(inputs), b(body), u(in.u ? body.at(in.u + 3 * index()) : Vector{0, 0, 0}) {}
  DIFFVBD_FN int64_t index() const { return b.scene * in.scene.bodies + b.body; }
  DIFFVBD_FN const T* plane(int32_t k) const {
    return in.floor.data + b.scene * in.floor.scene + kPlaneScalars * int64_t{k};
  }
  DIFFVBD_FN Vector at(int32_t i) const {
    const int32_t v = b.vertex(i);
    const Vector x = b.position(v) + u;
    const Batched<const T>& o = in.scene.origin;
    return o.data ? x + b.at(o.data + b.scene * o.scene + 3 * int64_t{v}) : x;
  }
  DIFFVBD_FN Vector way(int32_t i) const { return b.at(in.way + 3 * b.row(b.vertex(i))) - u; }
  DIFFVBD_FN bool counts(int32_t i) const { return !in.held[b.vertex(i)]; }
  DIFFVBD_FN Descent<T> descent(int32_t k, int32_t i) const { return Descent<T>(plane(k), at(i), way(i)); }
  template <class Team>
  DIFFVBD_FN AboveFloor found(const Team& team) const {
    return above_floor(
        team, b.size(), plane(0), in.planes, [&](int32_t i) { return at(i); }, [&](int32_t i) { return way(i); },
        [&](int32_t i) { return counts(i); });
  }
};

template <class T>
struct AboveFloorWays {
  AboveFloorInputs<T> in;
  T* left;        // [B, V, 3]
  bool* stopped;  // [B, bodies]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const DescendingBody<T> body(in, b);
    const AboveFloor found = body.found(team);
    if (team.leads()) stopped[body.index()] = found.stopped;
    team.each(b.size(), [&](int32_t i) { rigid::put(left + 3 * b.row(b.vertex(i)), found.left(body.way(i))); });
  }
};

// The adjoint of one vertex that decides what a plane does, of the adjoints of its room and of its motion toward it.
struct DescentAdjoint {
  Vector at, way, n;
  double height, dhat;
  template <class T>
  DIFFVBD_FN DescentAdjoint(const Descent<T>& d, const Vector& p, const Vector& w, double room, double toward) {
    const double outside = d.gap < d.deep ? 0 : 1, inside = d.gap < d.deep ? 1 : d.deep < d.gap ? 0 : 0.5;
    const double gap = d.safe < 0 ? 0 : room * (kKept * outside + kKeptDeep * inside);
    at = gap * d.n;
    way = -toward * d.n;
    n = gap * p - toward * w;
    height = -gap;
    dhat = kDeep * room * (kKeptDeep * (1 - inside) - kKept * outside);
  }
};

template <class T>
struct ReverseAboveFloor {
  AboveFloorInputs<T> in;
  const T* left;  // of the output
  T *x, *u, *way;
  T* floor;  // [B, bodies, planes, 7], zero at first, or null where not wanted

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const DescendingBody<T> body(in, b);
    const AboveFloor found = body.found(team);
    double total[4];  // adjoints of the shift and of the share
    team.template sum<4>(b.size(), total, [&](int32_t i, double* to) {
      const int64_t row = 3 * b.row(b.vertex(i));
      const Vector bar = b.at(left + row);
      rigid::put(x + row, Vector{0, 0, 0});
      rigid::put(way + row, found.share * bar);
      to[0] += bar.x, to[1] += bar.y, to[2] += bar.z, to[3] += dot(bar, body.way(i));
    });
    const Vector shift{total[0], total[1], total[2]};
    Vector u_bar = -found.share * shift;
    const bool shifts = !(found.share < 1), binds = !shifts || 0 < dot(found.shift, found.shift);
    // what decides on a plane: its largest excess, or the smallest share, which several may have
    const auto value_of = [&](int32_t k) {
      return team.least(b.size(), [&](int32_t i) {
        if (!body.counts(i)) return 1.0;
        const Descent<T> d = body.descent(k, i);
        return shifts ? -d.excess() : d.share();
      });
    };
    double planes = 0;
    for (int32_t k = 0; k < in.planes && !shifts; ++k) planes += value_of(k) == found.share;
    for (int32_t k = 0; k < in.planes && binds; ++k) {
      const double value = value_of(k);
      if (shifts ? !(value < 0) : value != found.share) continue;
      const auto decides = [&](const Descent<T>& d) {
        return d.closes() && (shifts ? -d.excess() : d.share()) == value;
      };
      double ties[1];
      team.template sum<1>(b.size(), ties,
                           [&](int32_t i, double* to) { to[0] += body.counts(i) && decides(body.descent(k, i)); });
      const Vector n{body.plane(k)[0], body.plane(k)[1], body.plane(k)[2]};
      const double each = shifts ? dot(n, shift) / ties[0] : total[3] / (planes * ties[0]);
      double sum[8];
      team.template sum<8>(b.size(), sum, [&](int32_t i, double* to) {
        if (!body.counts(i)) return;
        const Descent<T> d = body.descent(k, i);
        if (!decides(d)) return;
        const DescentAdjoint bar(d, body.at(i), body.way(i), shifts ? -each : each / d.toward,
                                 shifts ? each : -each * d.share() / d.toward);
        const int64_t row = 3 * b.row(b.vertex(i));
        rigid::add_to(x + row, bar.at);
        rigid::add_to(way + row, bar.way);
        const Vector own = bar.at - bar.way;
        to[0] += own.x, to[1] += own.y, to[2] += own.z;
        to[3] += bar.n.x, to[4] += bar.n.y, to[5] += bar.n.z, to[6] += bar.height, to[7] += bar.dhat;
      });
      u_bar += Vector{sum[0], sum[1], sum[2]};
      if (!floor || !team.leads()) continue;
      T* to = floor + (body.index() * in.planes + k) * kPlaneScalars;
      rigid::put(to, Vector{sum[3], sum[4], sum[5]} + (shifts ? -value : 0.0) * shift);
      to[3] = T(sum[6]), to[kPlaneDhat] = T(sum[7]);
    }
    if (in.u && team.leads()) rigid::put(u + 3 * body.index(), u_bar);
  }
};

}  // namespace diffvbd::contact
