// The near pairs of a scene: where their corners lie in its rows, the packs of their kernels, and the account of what
// is near.
#pragma once

#include <algorithm>
#include <atomic>
#include <vector>

#include "../contact/passes.h"
#include "contact_kernels.h"
#include "scene.h"

namespace diffvbd {

// One entry of a pair: 4 times the position in sweep order of each corner, or, of a corner point of colliders, what
// comes before 0 counted down; kind; the corner whose entry it is.
struct PairSite {
  int32_t at[4];
  uint8_t kind, own;
  uint8_t together;  // corners of its color, itself included (contact/pairs.h)
  bool is_first(int k) const { return k < contact::sides(kind); }
};

// Rows of four scalars of all corner points of a scene: positions, starts of the substep, and origins.
template <class T>
class PairRows {
 public:
  PairRows(const Plan& plan, const contact::ContactInputs<T>& in, int64_t scene, const int32_t* position, const T* x)
      : in_(in),
        position_(position),
        color_(plan.blocks, -1),
        x_(x),
        center_(4 * int64_t{plan.blocks} * kLanes),
        origin_(in.origin.data ? 4 * int64_t{plan.blocks} * kLanes : 0),
        collider_(4 * (in.corners - in.num_vertices), true),
        zero_(4, true) {
    for (int c = 0; c < plan.colors; ++c) {
      std::fill(color_.begin() + plan.color_block[c], color_.begin() + plan.color_block[c + 1], c);
    }
    for (int v = 0; v < in.num_vertices; ++v) {
      set_row(center_.get() + 4 * position[v], in.center_of(scene, v));
      if (in.origin.data) {
        set_row(origin_.get() + 4 * position[v], vector_at(in.origin.data + scene * in.origin.scene + int64_t{3} * v));
      }
    }
    for (int64_t i = 0; i < in.corners - in.num_vertices; ++i) {
      set_row(collider_.get() + 4 * i, vector_at(in.collider.data + scene * in.collider.scene + 3 * i));
    }
  }

  PairSite site(int32_t entry) const {
    const int32_t* record = in_.listed.pairs + int64_t{contact::kPairRow} * (entry >> 2);
    PairSite out;
    for (int k = 0; k < 4; ++k) {
      out.at[k] = record[k] < in_.num_vertices ? 4 * position_[record[k]] : ~(4 * (record[k] - in_.num_vertices));
    }
    out.kind = static_cast<uint8_t>(record[4]), out.own = static_cast<uint8_t>(entry & 3);
    out.together = 1;
    for (int k = 0; k < 4 && out.at[out.own] >= 0; ++k) {
      out.together += record[k] != record[out.own] && record[k] < in_.num_vertices &&
                      !contact::is_repeated(record, k) && are_together(record[k], record[out.own]);
    }
    return out;
  }

  // Whether two vertices are of one color.
  bool are_together(int v, int u) const { return color_[position_[v] / kLanes] == color_[position_[u] / kLanes]; }

  const T* x(int32_t at) const { return at < 0 ? collider_.get() + ~at : x_ + at; }
  const T* origin(int32_t at) const {
    if (!origin_.get()) return nullptr;
    return at < 0 ? zero_.get() : origin_.get() + at;
  }
  Vec3<T> moved(int32_t at) const { return at < 0 ? zero3<T>() : vector_at(x_ + at) - vector_at(center_.get() + at); }
  // As Source::is_far() says of the pair.
  bool is_far(const PairSite& site, const T* constants) const {
    return contact::is_above(
        site.kind, [&](int k) { return moved(site.at[k]); }, constants, contact::PairConstants<T>(constants).dhat);
  }

 private:
  static void set_row(T* row, const Vec3<T>& a) { put(row, a), row[3] = T(0); }

  const contact::ContactInputs<T>& in_;
  const int32_t* position_;
  std::vector<int32_t> color_;  // of each block, -1 where nothing moves
  const T* x_;
  const Buffer<T> center_, origin_, collider_, zero_;
};

// Entries of pairs gathered into packs of one kind for the kernels of pair_kernels.h, and their results in the order in
// which the entries came, so that sums do not depend on what shared a pack.

// deliver(mark, active, result) is called for each entry; `mark` says what the caller wants to know of it. The result
// of a pair that is not active has a Clearance alone.
template <class T, class Mark, class Deliver>
class PairBatches {
 public:
  PairBatches(PairKernel<T> kernel, const PairRows<T>& rows, T kappa, T h2, const Deliver& deliver)
      : kernel_(kernel), rows_(rows), kappa_(kappa), h2_(h2), deliver_(deliver) {}

  // turn: in the reverse p and d_raw of the corner
  void add(const PairSite& site, const T* constants, const T* turn, const Mark& mark) {
    if (size_ == kMost) flush();
    Waiting& waiting = waiting_[site.kind];
    if (waiting.count == kLanes) run(site.kind);
    marks_[size_] = mark;
    const int lane = waiting.count++;
    waiting.item[lane] = size_++;
    PairPack<T>& pack = waiting.pack;
    for (int k = 0; k < 4; ++k) {
      pack.x[k][lane] = rows_.x(site.at[k]);
      pack.origin[k][lane] = rows_.origin(site.at[k]);
    }
    pack.constants[lane] = constants;
    pack.own[lane] = static_cast<T>(site.own);
    pack.together[lane] = static_cast<T>(site.together);
    pack.turn[lane] = turn;
  }
  void flush() {
    for (int kind = 0; kind < kKinds; ++kind) run(kind);
    for (int i = 0; i < size_; ++i) deliver_(marks_[i], results_[i][kPairActive] != T(0), results_[i]);
    size_ = 0;
  }

 private:
  static constexpr int kKinds = 3, kMost = 16 * kLanes;
  struct Waiting {
    PairPack<T> pack;
    int item[kLanes];
    int count = 0;
  };

  void run(int kind) {
    Waiting& waiting = waiting_[kind];
    if (waiting.count == 0) return;
    PairPack<T>& pack = waiting.pack;
    T* out[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      out[l] = l < waiting.count ? results_[waiting.item[l]] : unused_;
      if (l < waiting.count) continue;
      for (int k = 0; k < 4; ++k) pack.x[k][l] = pack.x[k][0], pack.origin[k][l] = pack.origin[k][0];
      pack.constants[l] = pack.constants[0];
      pack.own[l] = pack.own[0];
      pack.together[l] = pack.together[0];
      pack.turn[l] = pack.turn[0];
    }
    kernel_(kind, pack, kappa_, h2_, out);
    waiting.count = 0;
  }

  const PairKernel<T> kernel_;
  const PairRows<T>& rows_;
  const T kappa_, h2_;
  const Deliver& deliver_;
  Waiting waiting_[kKinds];
  Mark marks_[kMost];
  T results_[kMost][kPairResult], unused_[kPairResult];
  int size_ = 0;
};

// Near pairs: listed pairs that can matter in a sweep, tracked from one color to the next. Most of a list is out of
// reach of the updates, and testing each pair of it in every color takes longer than the updates themselves.
//
// A vertex keeps an anchor: a motion since the start of the substep, a radius around it that its motion stays within,
// and the longest update that it may try. By those of its corners a pair is far if its gap exceeds dhat and what
// updates may close: the passes would leave it out at every visit. A vertex that leaves its radius takes a new anchor
// and looks at its far pairs anew. What is near stays near, until settle().

// The state of a near entry when it was last tested.
enum PairState : uint8_t {
  kNotSeen,  // nothing, in this list
  kFar,      // its gap is above dhat for sure; the Clearance has dhat for a gap
  kApart,    // its gap is above dhat, and the Clearance holds
  kTouching  // its gap is below
};

template <class T>
class NearPairs {
 public:
  // The near entries of one corner point, one after another.
  struct Entries {
    int64_t first;
    int count;
  };

  // motion(v): of corner point v since the start of the substep
  template <class Motion>
  NearPairs(const contact::ContactInputs<T>& in, int64_t scene, const PairRows<T>& rows, const Motion& motion)
      : in_(in),
        rows_(rows),
        row_(scene * in.corners),
        start_(in.listed.ptr[row_]),
        first_pair_(start_ / 4),
        anchors_(in.corners),
        clear_(in.corners, std::numeric_limits<T>::infinity()),
        due_(in.corners),
        stale_(in.corners, 1),
        near_((in.listed.ptr[row_ + in.corners] - start_) / 4),
        count_(in.corners),
        entries_(4 * near_.size()),
        sites_(4 * near_.size()),
        states_(4 * near_.size()),
        clearances_(4 * near_.size()) {
    for (int v = 0; v < in.corners; ++v) {
      anchors_[v] = {motion(v), T(0), T(0)};
      extend(anchors_[v]);
    }
    for (int64_t p = 0; p < pairs(); ++p) {
      const T slack = slack_of(first_pair_ + p);
      near_[p] = !is_far(first_pair_ + p);
      for (int k = 0; k < 4 && T(0) < slack; ++k) {
        T& least = clear_[in.listed.pairs[contact::kPairRow * (first_pair_ + p) + k]];
        least = slack < least ? slack : least;
      }
    }
  }

  int64_t pairs() const { return static_cast<int64_t>(near_.size()); }
  // Whether a pair is near; the lists of all corner points are stale then.
  void sort(int64_t p) { near_[p] = !is_far(first_pair_ + p); }
  // A new anchor with a smaller radius, before all pairs are sorted again.
  void settle(int v, const Vec3<T>& motion) {
    anchors_[v] = {motion, T(kLeft) * anchors_[v].radius, T(kLeft) * anchors_[v].length};
    extend(anchors_[v]);
    stale_[v] = 1;
  }
  bool has_pairs(int v) const { return in_.listed.ptr[row_ + v] < in_.listed.ptr[row_ + v + 1]; }

  // The list with what is near.
  contact::PairList view() const {
    contact::PairList out = in_.listed;
    out.near = entries_.get(), out.near_count = count_.data(), out.near_row = row_, out.near_start = start_;
    return out;
  }

  // Vertex v goes from one motion to another, or a part of it, in an update of this length, guard included; 0 in
  // the reverse. Its pairs are looked at in search(), once all vertices of its color have said so.
  void go(int v, const Vec3<T>& from, const Vec3<T>& to, T length) {
    Anchor& a = anchors_[v];
    const bool leaves =
        !(contact::length_of(to - a.motion) <= a.radius) || !(contact::length_of(from - a.motion) <= a.radius);
    due_[v] = leaves || a.length < length;
    if (!due_[v]) return;
    if (leaves) {
      a.motion = to;
      a.radius = T(kAhead) * contact::length_of(to - from) + T(kRounded) * contact::length_of(to);
    }
    if (a.length < length) a.length = T(kAhead) * length;
    extend(a);
  }
  void search(int v) {
    if (!due_[v]) return;
    due_[v] = 0;
    const T reach = reach_.load(std::memory_order_relaxed);
    if (reach < clear_[v]) return;
    const int32_t* entry = in_.listed.entry + in_.listed.ptr[row_ + v];
    const int count = in_.listed.ptr[row_ + v + 1] - in_.listed.ptr[row_ + v];
    for (int e = 0; e < count; ++e) {
      const int64_t pair = entry[e] >> 2;
      uint8_t* near = near_.data() + (pair - first_pair_);
      if (load(near) || reach < slack_of(pair) || is_far(pair)) continue;
      store(near);
      for (int k = 0; k < 4; ++k) store(stale_.data() + in_.listed.pairs[contact::kPairRow * pair + k]);
    }
  }
  // Whether v has near pairs; after this view() has them.
  bool refresh(int v) {
    if (!stale_[v]) return count_[v] > 0;
    stale_[v] = 0;
    const int32_t *from = in_.listed.entry + in_.listed.ptr[row_ + v],
                  *end = in_.listed.entry + in_.listed.ptr[row_ + v + 1];
    const int64_t first = in_.listed.ptr[row_ + v] - start_;
    int32_t *out = entries_.get() + first, *begin = out;
    for (; from < end; ++from) {
      *out = *from;
      out += near_[(*from >> 2) - first_pair_];
    }
    count_[v] = static_cast<int32_t>(out - begin);
    for (int64_t e = first; e < first + count_[v]; ++e) {
      sites_.get()[e] = rows_.site(entries_.get()[e]);
      states_.get()[e] = kNotSeen;
    }
    return count_[v] > 0;
  }
  Entries of(int v) const { return {in_.listed.ptr[row_ + v] - start_, count_[v]}; }
  int32_t entry(int64_t e) const { return entries_.get()[e]; }
  const PairSite& site(int64_t e) const { return sites_.get()[e]; }
  uint8_t& state(int64_t e) { return states_.get()[e]; }
  contact::Clearance<T>& clearance(int64_t e) { return clearances_.get()[e]; }

 private:
  static constexpr double kAhead = 2.0;     // of what a vertex does, up to where it keeps its anchor
  static constexpr double kLeft = 0.25;     // of that, for what comes after the first sweep
  static constexpr double kRounded = 1e-6;  // of lengths, that rounding cannot reach

  struct alignas(4 * sizeof(T)) Anchor {
    Vec3<T> motion;
    T radius, length;
  };

  // Several threads may find the same pair.
  static bool load(const uint8_t* flag) { return __atomic_load_n(flag, __ATOMIC_RELAXED) != 0; }
  static void store(uint8_t* flag) { __atomic_store_n(flag, uint8_t{1}, __ATOMIC_RELAXED); }

  // A bound of what two anchors and an update can close: most far pairs are far by that.
  void extend(const Anchor& a) {
    const T own = T(2 + kRounded) * (contact::length_of(a.motion) + a.radius + a.length);
    T most = reach_.load(std::memory_order_relaxed);
    while (most < own && !reach_.compare_exchange_weak(most, own, std::memory_order_relaxed)) {
    }
  }
  T slack_of(int64_t pair) const {
    const T* constants = in_.constants + contact::kConstants * pair;
    return contact::PairHints<T>(constants).gap - contact::PairConstants<T>(constants).dhat;
  }
  bool is_far(int64_t pair) const {
    const int32_t* record = in_.listed.pairs + contact::kPairRow * pair;
    const T* constants = in_.constants + contact::kConstants * pair;
    const int first = contact::sides(record[4]);
    const Anchor* a[4];
    T radius[2] = {T(0), T(0)}, length = contact::PairConstants<T>(constants).dhat, most = T(0);
    for (int k = 0; k < 4; ++k) {
      a[k] = anchors_.data() + record[k];
      T& of_side = radius[k < first ? 0 : 1];
      of_side = of_side < a[k]->radius ? a[k]->radius : of_side;
      length = length < a[k]->length ? a[k]->length : length;
    }
    const T slack = contact::PairHints<T>(constants).gap - length - T(1 + kRounded) * (radius[0] + radius[1]);
    if (!(T(0) < slack)) return false;
    for (int i = 0; i < first; ++i) {
      for (int j = first; j < 4; ++j) {
        const Vec3<T> d = a[i]->motion - a[j]->motion;
        const T square = dot(d, d);
        most = most < square ? square : most;
      }
    }
    return T(1 + 4 * kRounded) * most < slack * slack;
  }

  const contact::ContactInputs<T>& in_;
  const PairRows<T>& rows_;
  const int64_t row_, start_, first_pair_;
  std::vector<Anchor> anchors_;
  std::atomic<T> reach_{T(0)};
  std::vector<T> clear_;  // of the pairs of a corner point that may be far, the least gap less dhat
  std::vector<uint8_t> due_, stale_, near_;
  std::vector<int32_t> count_;
  // with room for all entries; a corner point's begin where its listed ones do
  const Buffer<int32_t> entries_;
  const Buffer<PairSite> sites_;
  const Buffer<uint8_t> states_;
  const Buffer<contact::Clearance<T>> clearances_;
};

}  // namespace diffvbd
