#include "contact.h"

#include <algorithm>

namespace diffvbd {

using namespace contact;

template <class T>
ContactScene<T>::ContactScene(const Plan& plan, const ContactInputs<T>& in, const int32_t* position, int64_t scene,
                              SceneView<T>& s, T time_step, const ContactAdjoints<T>* reverse)
    : plan_(plan),
      in_(in),
      reverse_(reverse),
      scene_(scene),
      s_(s),
      h_(time_step),
      before_(reverse ? 0 : int64_t{plan.blocks} * kLanes * 4),
      positions_{s.x, position},
      source_{in, scene, positions_} {
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
void ContactScene<T>::limit(int64_t first, int64_t last, int64_t begin, int64_t end, uint8_t* limits) const {
  const Before before{s_.x, before_.get(), positions_.position, first * kLanes, last * kLanes};
  const Source<T, Before> source{in_, scene_, before};
  for (int64_t at = begin * kLanes; at < end * kLanes; ++at) {
    const int32_t v = plan_.order[at];
    if (v < 0) continue;
    T* x = s_.x + 4 * at;
    const Vec3<T> from = vector_at(before_.get() + 4 * at), d = vector_at(x) - from;
    const int exponent = limit_by_pairs(source, v, d, 0, 1, limit_by_room(source, v, from, d));
    limits[v] = static_cast<uint8_t>(exponent);
    if (exponent > 0) {
      const Vec3<T> to = from + limit_of<T>(exponent) * d;
      x[0] = to.x, x[1] = to.y, x[2] = to.z;
    }
  }
}

template <class T>
T* ContactScene<T>::record(int64_t block, int lane, int scalar) const {
  return s_.contact + (block * kContactScalars + scalar) * kLanes + lane;
}

// Calls f(vertex, block, lane) for the vertices of the blocks that have pairs or a floor to rub against.
template <class T>
template <class F>
void ContactScene<T>::each_vertex(int64_t begin, int64_t end, const F& f) const {
  for (int64_t at = begin * kLanes; at < end * kLanes; ++at) {
    const int32_t v = plan_.order[at];
    if (v < 0) continue;
    const int64_t row = scene_ * in_.corners + v;
    const bool touches = in_.listed.ptr[row] < in_.listed.ptr[row + 1] || in_.planes > 0 ||
                         (in_.lag && in_.lagged.ptr[row] < in_.lagged.ptr[row + 1]);
    if (touches) f(v, at / kLanes, static_cast<int>(at % kLanes));
  }
}

template <class T>
void ContactScene<T>::assemble(int64_t begin, int64_t end) const {
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    Vec3<T> g = zero3<T>();
    Sym3<T> H = diagonal(T(0));
    add_pairs(source_, v, 0, 1, h_, g, H);
    const T values[] = {g.x, g.y, g.z, H.xx, H.xy, H.xz, H.yy, H.yz, H.zz};
    for (int i = 0; i < 9; ++i) *record(block, lane, i) = values[i];
  });
}

template <class T>
void ContactScene<T>::prepare(int sweep, int tape_policy, int64_t begin, int64_t end, const uint8_t* limits) const {
  const int64_t rows = tape_rows(tape_policy, true);
  for (int64_t block = begin; block < end; ++block) {
    const int count = plan_.block_rank[block + 1] - plan_.block_rank[block];
    const T* at = s_.tape + sweep * rows * plan_.num_active + plan_.block_rank[block];
    for (int lane = 0; lane < count; ++lane) {
      for (int c = 0; c < 3; ++c) s_.x[4 * (block * kLanes + lane) + c] = at[c * plan_.num_active + lane];
      s_.limit[block * kLanes + lane] = limit_of<T>(limits[plan_.order[block * kLanes + lane]]);
    }
  }
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    Vec3<T> now = zero3<T>(), prev = zero3<T>();
    take_pairs(in_, *reverse_, scene_, v, 0, 1, now, prev);
    add_at(s_.x_bar + 4 * (block * kLanes + lane), now);
    add_at(reverse_->prev + 3 * (scene_ * in_.corners + v), prev);
  });
}

template <class T>
void ContactScene<T>::reverse(int64_t begin, int64_t end) const {
  each_vertex(begin, end, [&](int32_t v, int64_t block, int lane) {
    const T* turn = s_.turn + block * 6 * kLanes + lane;
    const auto at = [&](int i) { return turn[i * kLanes]; };
    Vec3<T> own = zero3<T>();
    reverse_pairs(source_, *reverse_, v, 0, 1, h_, {at(0), at(1), at(2)}, {at(3), at(4), at(5)}, own);
    add_at(s_.x_bar + 4 * (block * kLanes + lane), own);
    add_at(reverse_->prev + 3 * (scene_ * in_.corners + v), -own);
  });
}

template <class T>
void ContactScene<T>::finish(T* collider_bar) const {
  for (int32_t v = 0; v < in_.corners; ++v) {
    Vec3<T> now = zero3<T>(), prev = zero3<T>();
    take_pairs(in_, *reverse_, scene_, v, 0, 1, now, prev);
    add_at(v < in_.num_vertices ? s_.x_bar + int64_t{4} * positions_.position[v]
                                : collider_bar + 3 * (v - in_.num_vertices),
           now);
    add_at(reverse_->prev + 3 * (scene_ * in_.corners + v), prev);
  }
}

template class ContactScene<float>;
template class ContactScene<double>;

}  // namespace diffvbd
