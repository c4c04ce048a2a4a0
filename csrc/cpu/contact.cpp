#include "contact.h"

#include <algorithm>

#include "../contact/passes.h"
#include "near.h"

namespace diffvbd {

using namespace contact;

template <class T>
ContactScene<T>::ContactScene(const Plan& plan, const ContactInputs<T>& in, const int32_t* position, int64_t scene,
                              SceneView<T>& s, T time_step, const ContactAdjoints<T>* reverse)
    : plan_(plan),
      given_(in),
      in_(in),
      reverse_(reverse),
      scene_(scene),
      s_(s),
      h_(time_step),
      kernels_(pair_kernels<T>()),
      before_(reverse ? 0 : int64_t{plan.blocks} * kLanes * 4),
      positions_{s.x, position, &rows_},
      rows_(plan, in, scene, position, s.x),
      near_(given_, scene, rows_, [&](int v) { return Source<T, Positions>{in, scene, positions_}.moved(v); }),
      source_{in_, scene, positions_} {
  in_.listed = near_.view();
  for (int64_t at = 0; at < int64_t{plan.blocks} * kLanes; ++at) {
    for (int i = 0; i < kContactScalars; ++i) *record(at / kLanes, static_cast<int>(at % kLanes), i) = T(0);
    if (s.limit) s.limit[at] = T(1);
  }
}

template <class T>
void ContactScene<T>::remember(int64_t begin, int64_t end) const {
  std::copy(s_.x + 4 * begin * kLanes, s_.x + 4 * end * kLanes, before_.get() + 4 * begin * kLanes);
}

template <class T>
void ContactScene<T>::propose(int64_t first, int64_t last, int64_t begin, int64_t end, uint8_t* limits) const {
  const Before before{s_.x, before_.get(), positions_.position, first * kLanes, last * kLanes};
  const Source<T, Before> source{in_, scene_, before};
  for (int64_t at = begin * kLanes; at < end * kLanes; ++at) {
    const int32_t v = plan_.order[at];
    if (v < 0) continue;
    const Vec3<T> from = vector_at(before_.get() + 4 * at), d = vector_at(s_.x + 4 * at) - from;
    const TrustRegion<T> region(source, v);
    const int exponent = region.limit(from, d);
    limits[v] = static_cast<uint8_t>(exponent);
    if (!near_.has_pairs(v)) continue;
    const Vec3<T> motion = source.moved(v), displacement = limit_of<T>(exponent) * d;
    near_.go(v, motion, motion + displacement, length_of(displacement) / T(kBothGapFraction) + region.guard(from));
  }
}

template <class T>
void ContactScene<T>::search(int64_t begin, int64_t end) const {
  for (int64_t at = begin * kLanes; at < end * kLanes; ++at) {
    if (plan_.order[at] >= 0) near_.search(plan_.order[at]);
  }
}

template <class T>
void ContactScene<T>::settle(Team::Member& member) const {
  member.items_sync(in_.num_vertices, [&](int64_t v) { near_.settle(static_cast<int>(v), source_.moved(v)); });
  member.items_sync(near_.pairs(), [&](int64_t p) { near_.sort(p); });
}

template <class T>
void ContactScene<T>::limit(int64_t first, int64_t last, int64_t begin, int64_t end, uint8_t* limits) const {
  const Before before{s_.x, before_.get(), positions_.position, first * kLanes, last * kLanes};
  const Source<T, Before> source{in_, scene_, before};
  for (int64_t at = begin * kLanes; at < end * kLanes; ++at) {
    const int32_t v = plan_.order[at];
    if (v < 0) continue;
    const bool near = near_.refresh(v);
    if (!near && limits[v] == 0) continue;
    T* x = s_.x + 4 * at;
    const Vec3<T> from = vector_at(before_.get() + 4 * at), d = vector_at(x) - from;
    int exponent = limits[v];
    if (near) exponent = limit_by_near(source, v, d, exponent);
    limits[v] = static_cast<uint8_t>(exponent);
    if (exponent > 0) {
      const Vec3<T> to = from + limit_of<T>(exponent) * d;
      put(x, to);
    }
  }
}

template <class T>
T* ContactScene<T>::record(int64_t block, int lane, int scalar) const {
  return s_.contact + (block * kContactScalars + scalar) * kLanes + lane;
}

// Calls f(vertex, block, lane) for the vertices of the blocks that have pairs or friction on a floor.
template <class T>
template <class F>
void ContactScene<T>::each_vertex(int64_t begin, int64_t end, const F& f) const {
  for (int64_t at = begin * kLanes; at < end * kLanes; ++at) {
    const int32_t v = plan_.order[at];
    if (v < 0) continue;
    const int64_t row = scene_ * in_.corners + v;
    near_.refresh(v);
    const bool touches =
        near_.has_pairs(v) || in_.planes > 0 || (in_.lag && in_.lagged.ptr[row] < in_.lagged.ptr[row + 1]);
    if (touches) f(v, at / kLanes, static_cast<int>(at % kLanes));
  }
}

// Calls look(e, constants) for the near entries e of vertex v that are not far.
template <class T>
template <class F>
void ContactScene<T>::each_pair(int32_t v, const F& look) const {
  const auto all = near_.of(v);
  for (int64_t e = all.first; e < all.first + all.count; ++e) {
    const T* constants = in_.constants + kConstants * int64_t{near_.entry(e) >> 2};
    // what touched a sweep ago most often touches again
    if (near_.state(e) != kTouching && rows_.is_far(near_.site(e), constants)) {
      near_.state(e) = kFar;
      near_.clearance(e).gap = PairConstants<T>(constants).dhat;
      continue;
    }
    look(e, constants);
  }
}

// The exponent of the limit of a vertex by all its pairs, of what assemble() has seen at the same positions; looks
// closer only where that does not settle it.
template <class T>
int ContactScene<T>::limit_by_near(const Source<T, Before>& source, int32_t v, const Vec3<T>& d, int exponent) const {
  const T length = length_of(d), guard = TrustRegion<T>(source, v).guard(source.x(v));
  const int64_t begin = 4 * source.positions.first, end = 4 * source.positions.last;
  const auto all = near_.of(v);
  for (int64_t e = all.first; e < all.first + all.count; ++e) {
    const PairSite& site = near_.site(e);
    if (!is_limiting(in_.listed.pairs + kPairRow * int64_t{near_.entry(e) >> 2})) continue;
    const bool first = site.is_first(site.own);
    bool both = false;
    for (int k = 0; k < 4; ++k) {
      both = both || (site.is_first(k) != first && begin <= site.at[k] && site.at[k] < end);
    }
    const T fraction = both ? T(kBothGapFraction) : T(kGapFraction);
    const Clearance<T>& clearance = near_.clearance(e);
    const uint8_t state = near_.state(e);
    const T part = limit_of<T>(exponent);
    if (state == kFar && part * length / fraction + guard < clearance.gap) continue;
    if (state >= kApart && clearance.holds(part * d, fraction, guard)) continue;
    exponent = limit_by_pair(source, near_.entry(e), d, length, guard, exponent);
  }
  return exponent;
}

template <class T>
void ContactScene<T>::assemble(int64_t begin, int64_t end) const {
  struct Mark {
    int64_t e;
    T* to;
  };
  const auto deliver = [&](const Mark& mark, bool active, const T* result) {
    near_.state(mark.e) = active ? kTouching : kApart;
    near_.clearance(mark.e) = {vector_at(result + kPairToward), result[kPairGap], result[kPairSlack]};
    if (!active) return;
    for (int row = 0; row < 3; ++row) {
      for (int i = 0; i < 3; ++i) mark.to[(3 * row + i) * kLanes] += result[kPairBlock + 4 * row + i];
    }
  };
  PairBatches<T, Mark, decltype(deliver)> batches(kernels_.add, rows_, kappa(), h_ * h_, deliver);
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    T* to = record(block, lane, 0);
    for (int i = 0; i < kContactScalars; ++i) to[i * kLanes] = T(0);
    each_pair(v, [&](int64_t e, const T* constants) { batches.add(near_.site(e), constants, nullptr, Mark{e, to}); });
  });
  batches.flush();
  if (!in_.lag && in_.planes == 0) return;
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    T* to = record(block, lane, 0);
    const auto at = [&](int i) { return to[i * kLanes]; };
    Vec3<T> g{at(0), at(1), at(2)};
    Sym3<T> H{at(3), at(4), at(5), at(6), at(7), at(8)};
    add_lags(source_, v, h_, g, H);
    const T values[] = {g.x, g.y, g.z, H.xx, H.xy, H.xz, H.yy, H.yz, H.zz};
    for (int i = 0; i < kContactScalars; ++i) to[i * kLanes] = values[i];
  });
}

template <class T>
void ContactScene<T>::prepare(int sweep, int64_t rows, int64_t begin, int64_t end, const uint8_t* limits) const {
  for (int64_t block = begin; block < end; ++block) {
    const int count = plan_.block_rank[block + 1] - plan_.block_rank[block];
    const T* at = s_.tape + sweep * rows * plan_.num_active + plan_.block_rank[block];
    for (int lane = 0; lane < count; ++lane) {
      const int32_t v = plan_.order[block * kLanes + lane];
      const Vec3<T> after = vector_at(s_.x + 4 * (block * kLanes + lane));
      for (int c = 0; c < 3; ++c) s_.x[4 * (block * kLanes + lane) + c] = at[c * plan_.num_active + lane];
      if (near_.has_pairs(v)) {
        const Vec3<T> center = in_.center_of(scene_, v);
        near_.go(v, after - center, vector_at(s_.x + 4 * (block * kLanes + lane)) - center, T(0));
      }
      s_.limit[block * kLanes + lane] = limit_of<T>(limits[v]);
    }
  }
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    Vec3<T> now = zero3<T>(), prev = zero3<T>();
    gather_pairs(in_, *reverse_, scene_, v, 0, 1, now, prev);
    add_to(s_.x_bar + 4 * (block * kLanes + lane), now);
    add_to(reverse_->prev + 3 * (scene_ * in_.corners + v), prev);
  });
}

template <class T>
void ContactScene<T>::reverse(int64_t begin, int64_t end) const {
  const auto deliver = [&](int64_t e, bool active, const T* result) {
    near_.state(e) = active ? kTouching : kApart;
    if (!active) return;
    const int64_t entry = near_.entry(e);
    scatter(*reverse_, entry,
            {vector_at(result), vector_at(result + 4), vector_at(result + 8), vector_at(result + 12)});
    reverse_->kappa[entry] += result[kPairKappa];
  };
  PairBatches<T, int64_t, decltype(deliver)> batches(kernels_.reverse, rows_, kappa(), h_ * h_, deliver);
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    const T* turn = s_.turn + block * 6 * kLanes + lane;
    each_pair(v, [&](int64_t e, const T* constants) { batches.add(near_.site(e), constants, turn, e); });
    const auto at = [&](int i) { return turn[i * kLanes]; };
    const Vec3<T> p{at(0), at(1), at(2)}, d_raw{at(3), at(4), at(5)};
    Vec3<T> own = zero3<T>();
    reverse_lags(source_, *reverse_, v, h_, p, d_raw, own);
    add_to(s_.x_bar + 4 * (block * kLanes + lane), own);
    add_to(reverse_->prev + 3 * (scene_ * in_.corners + v), -own);
  });
  batches.flush();
}

template <class T>
void ContactScene<T>::finish(T* collider_bar) const {
  for (int32_t v = 0; v < in_.corners; ++v) {
    near_.refresh(v);
    Vec3<T> now = zero3<T>(), prev = zero3<T>();
    gather_pairs(in_, *reverse_, scene_, v, 0, 1, now, prev);
    add_to(v < in_.num_vertices ? s_.x_bar + int64_t{4} * positions_.position[v]
                                : collider_bar + 3 * (v - in_.num_vertices),
           now);
    add_to(reverse_->prev + 3 * (scene_ * in_.corners + v), prev);
  }
}

#ifdef DIFFVBD_SCALAR
template class ContactScene<DIFFVBD_SCALAR>;
#else
template class ContactScene<float>;
template class ContactScene<double>;
#endif

}  // namespace diffvbd
