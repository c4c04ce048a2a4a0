#include "coarse.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "../subspace/coarse.h"

namespace diffvbd {

namespace {
// One member of a team sums for a body, in the order of its items.
struct Member {
  template <int n, class F>
  void sum(int32_t count, double (&out)[n], const F& f) const {
    std::fill(out, out + n, 0.0);
    for (int32_t i = 0; i < count; ++i) f(i, out);
  }
};
}  // namespace

template <class T>
CoarseScene<T>::CoarseScene(const Plan& plan, const StepInputs<T>& in, int64_t scene, SceneView<T>& s)
    : plan_(plan),
      in_(in),
      c_(*in.coarse),
      scene_(scene),
      s_(s),
      kernels_(coarse_kernels<T>(in.energies)),
      failures_(c_.plan.bodies, 0),
      plain_(c_.plan.bodies, 0),
      gradient_(size_t(plan.blocks) * kLanes * 4, true),
      displacement_(size_t(plan.blocks) * kLanes * 4, true),
      wanted_(size_t(plan.blocks) * kLanes * 4, true),
      material_(size_t(c_.plan.tet_blocks) * kMaterialScalars * kLanes),
      coarse_(size_t(c_.plan.functions) * 4, true),
      rows_(size_t(c_.plan.functions) * 7, true),
      turns_(size_t(c_.matrix_bar ? c_.corrections : 1) * c_.plan.functions * 3, true),
      matrix_(c_.has_vertex_blocks ? size_t(9) * c_.plan.cells : 0) {
  s.gradient = gradient_.get();
  s.displacement = displacement_.get();
  s.wanted = wanted_.get();
  const coarse::Plan& p = c_.plan;
  sums_ = Buffer<double>(size_t(p.parts) * coarse::kDegree);
  if (!(in.energies & kElastic)) return;
  for (int m = 0; m < kMaterialScalars; ++m) {
    const Batched<const T>& given = in.material[m];
    const T* of_tet = given.data + scene * given.scene;
    for (int64_t block = 0; block < p.tet_blocks; ++block) {
      T* to = material_.get() + (block * kMaterialScalars + m) * kLanes;
      for (int l = 0; l < kLanes; ++l) to[l] = of_tet[p.tet[block * kLanes + l] * given.item];
    }
  }
}

template <class T>
void CoarseScene<T>::add_vertex_blocks(Team::Member& member) {
  if (!c_.has_vertex_blocks) return;
  const coarse::Plan& p = c_.plan;
  std::vector<T> work;  // of this member
  member.items_sync(p.bodies, [&](int64_t b) {
    const coarse::Line<T, StepInputs<T>> line{
        in_, c_, s_.data_start, scene_, static_cast<int32_t>(b), s_.x, s_.displacement};
    const int32_t first = p.function_ptr[b];
    const int64_t n = int64_t{3} * (p.function_ptr[b + 1] - first), own = int64_t{9} * p.mass_ptr[b];
    T* to = matrix_.get() + own;
    std::vector<std::pair<int32_t, Sym3<double>>> blocks;
    for (int32_t i = 0; i < line.size(); ++i) {
      const Sym3<double> H = line.block(i);
      if (coarse::acts(H)) blocks.emplace_back(i, H);
    }
    if (blocks.empty() && plain_[b]) return;
    plain_[b] = blocks.empty();
    std::copy_n(c_.factor.data + scene_ * c_.factor.scene + own, n * n, to);
    for (const auto& [i, H] : blocks) {
      const double rows[3][3] = {{H.xx, H.xy, H.xz}, {H.xy, H.yy, H.yz}, {H.xz, H.yz, H.zz}};
      const int32_t position = p.list_position[p.list_ptr[b] + i];
      for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
        for (int32_t f = p.position_ptr[position]; f < p.position_ptr[position + 1]; ++f) {
          T* block = to + 3 * ((p.function[e] - first) * n + p.function[f] - first);
          const double weight = double(c_.weight[e]) * double(c_.weight[f]);
          for (int r = 0; r < 3; ++r) {
            for (int c = 0; c < 3; ++c) block[r * n + c] += T(weight * rows[r][c]);
          }
        }
      }
    }
    work.resize(n * kLanes);
    kernels_.factor(n, work.data(), to);
  });
}

// x := A^-1 x body by body, three scalars a function
template <class T>
void CoarseScene<T>::solve(T* x, Team::Member& member) const {
  const coarse::Plan& p = c_.plan;
  const T* factor = c_.has_vertex_blocks ? matrix_.get() : c_.factor.data + scene_ * c_.factor.scene;
  member.items_sync(p.bodies, [&](int64_t b) {
    const int64_t first = int64_t{3} * p.function_ptr[b], n = int64_t{3} * p.function_ptr[b + 1] - first;
    kernels_.solve(factor + int64_t{9} * p.mass_ptr[b], n, x + first);
  });
}

// to := the motion of the vertices by sign a, three scalars a function
template <class T>
void CoarseScene<T>::prolong(const T* a, T sign, T* to, Team::Member& member) {
  const coarse::Plan& p = c_.plan;
  T* coarse = coarse_.get();
  member.items_sync(p.functions, [&](int64_t f) {
    for (int i = 0; i < 3; ++i) coarse[4 * f + i] = sign * a[3 * f + i];
  });
  member.each_sync(0, p.positions, [&](int64_t begin, int64_t end) {
    kernels_.gather(p.position_ptr, p.function, c_.weight, coarse, to, begin, end);
  });
}

template <class T>
void CoarseScene<T>::correct(int k, Team::Member& member) {
  const coarse::Plan& p = c_.plan;
  T *a = tape(k), *lengths = a + int64_t{3} * p.functions;
  if (over_) {  // in the state that all members have seen
    return member.items_sync(c_.tape_size(), [&](int64_t i) { a[i] = T(0); });
  }
  T* restricted = rows_.get() + 4 * int64_t{p.functions};
  member.each_sync(0, plan_.color_block[plan_.colors],
                   [&](int64_t begin, int64_t end) { kernels_.gradient(plan_, s_, in_.parameters, begin, end); });
  member.each_sync(0, p.functions, [&](int64_t begin, int64_t end) {
    kernels_.gather(p.row_ptr, p.row, c_.row_weight, s_.gradient, rows_.get(), begin, end);
    for (int64_t f = begin; f < end; ++f) {
      for (int i = 0; i < 3; ++i) a[3 * f + i] = restricted[3 * f + i] = rows_.get()[4 * f + i];
    }
  });
  add_vertex_blocks(member);
  solve(a, member);
  prolong(a, T(-1), s_.displacement, member);
  member.items_sync(p.parts, [&](int64_t i) {
    double* sum = sums_.get() + i * coarse::kDegree;
    std::fill(sum, sum + coarse::kDegree, 0.0);
    if (!(in_.energies & kElastic)) return;
    kernels_.line(p.corner, c_.rest.data + scene_ * c_.rest.scene, material_.get(), s_.x, s_.displacement,
                  p.part_begin[i], p.part_begin[i + 1], sum);
  });
  member.items_sync(p.bodies, [&](int64_t b) { decide(static_cast<int32_t>(b), a, lengths + b); });
  if (member.first == 0) {
    over_ = std::all_of(failures_.begin(), failures_.end(), [](int n) { return n >= coarse::kFailures; });
  }
  T* before = lengths + p.bodies;
  member.items_sync(p.positions, [&](int64_t i) {
    if (p.position_body[i] < 0) return;
    const T length = lengths[p.position_body[i]];
    for (int c = 0; c < 3; ++c) {
      if (c_.keeps_positions) before[3 * i + c] = s_.x[4 * i + c];
      if (length > 0) s_.x[4 * i + c] += length * s_.displacement[4 * i + c];  // one that was refused may be no number
    }
  });
}

template <class T>
int32_t CoarseScene<T>::body_of(int64_t function) const {
  const int32_t *first = c_.plan.function_ptr, *end = first + c_.plan.bodies + 1;
  return static_cast<int32_t>(std::upper_bound(first, end, function) - first) - 1;
}

// Sums of one body belong to one member, in a fixed order.
template <class T>
void CoarseScene<T>::decide(int32_t body, T* a, T* length) {
  const coarse::Plan& p = c_.plan;
  const int32_t first = p.function_ptr[body], count = p.function_ptr[body + 1] - first;
  const coarse::Line<T, StepInputs<T>> line{in_, c_, s_.data_start, scene_, body, s_.x, s_.displacement};
  const T* restricted = rows_.get() + 4 * int64_t{p.functions};
  *length = failures_[body] < coarse::kFailures ? T(coarse::decide(line, a, restricted, sums_.get(), Member{})) : T(0);
  if (*length > 0) return;
  ++failures_[body];
  std::fill(a + 3 * first, a + 3 * (first + count), T(0));  // it may be no number
}

// Takes into x_bar what the updates of lower colors have added since a vertex's last turn, and clears these rows, which
// its next turn reads again. Those of higher colors are written anew before it.
template <class T>
void CoarseScene<T>::flush(Team::Member& member) {
  member.each_sync(0, plan_.color_block[plan_.colors], [&](int64_t begin, int64_t end) {
    int color = 0;
    for (int64_t block = begin; block < end; ++block) {
      while (block >= plan_.color_block[color + 1]) ++color;
      const int32_t below = kRow * plan_.block_edge[plan_.color_block[color]] * kLanes;
      if (below == 0) continue;
      T* x_bar = s_.x_bar + 4 * block * kLanes;
      for (int64_t e = plan_.block_incoming[block]; e < plan_.block_incoming[block + 1]; ++e) {
        for (int l = 0; l < kLanes; ++l) {
          const int32_t row = plan_.incoming[e * kLanes + l];
          if (row >= below) continue;
          Row<T> sum = Row<T>::load(x_bar + 4 * l);
          sum.v += Row<T>::load(s_.rows + row).v;
          sum.store(x_bar + 4 * l);
          Row<T>{}.store(s_.rows + row);
        }
      }
    }
  });
}

template <class T>
void CoarseScene<T>::reverse(int k, Team::Member& member) {
  const coarse::Plan& p = c_.plan;
  const T *a = tape(k), *lengths = a + int64_t{3} * p.functions, *before = lengths + p.bodies;
  if (std::all_of(lengths, lengths + p.bodies, [](T s) { return s == 0; })) return;
  T* q = turn(k);
  flush(member);
  // back to where the correction began: x -= s (-P a)
  prolong(a, T(-1), s_.wanted, member);
  member.items_sync(p.positions, [&](int64_t i) {
    if (p.position_body[i] < 0) return;
    const T length = lengths[p.position_body[i]];
    for (int c = 0; c < 3; ++c) {
      if (c_.keeps_positions) {
        s_.x[4 * i + c] = before[3 * i + c];
      } else if (length > 0) {
        s_.x[4 * i + c] -= length * s_.wanted[4 * i + c];
      }
    }
  });
  add_vertex_blocks(member);
  // u = P' x_bar, q = -s A^-1 u
  member.each_sync(0, p.functions, [&](int64_t begin, int64_t end) {
    kernels_.gather(p.row_ptr, p.row, c_.row_weight, s_.x_bar, rows_.get(), begin, end);
    int32_t b = body_of(begin);
    for (int64_t f = begin; f < end; ++f) {
      while (f >= p.function_ptr[b + 1]) ++b;
      for (int i = 0; i < 3; ++i) q[3 * f + i] = -lengths[b] * rows_.get()[4 * f + i];
    }
  });
  solve(q, member);
  member.items_sync(p.bodies, [&](int64_t b) {
    if (!(lengths[b] > 0)) std::fill(q + 3 * p.function_ptr[b], q + 3 * p.function_ptr[b + 1], T(0));
  });
  // w = P q, and the Hessian times w
  prolong(q, T(1), s_.displacement, member);
  member.each_sync(0, plan_.blocks,
                   [&](int64_t begin, int64_t end) { kernels_.reverse(plan_, s_, in_.parameters, begin, end); });
}

// The adjoint of the matrix: -q a' of all corrections, in one pass over it.
template <class T>
void CoarseScene<T>::finish(Team::Member& member) {
  if (!c_.matrix_bar) return;
  const coarse::Plan& p = c_.plan;
  T* bar = c_.matrix_bar + scene_ * 9 * int64_t{p.cells};
  member.each_sync(0, p.functions, [&](int64_t begin, int64_t end) {
    int32_t b = body_of(begin);
    while (begin < end) {
      while (begin >= p.function_ptr[b + 1]) ++b;
      const int64_t first = p.function_ptr[b], last = std::min<int64_t>(end, p.function_ptr[b + 1]);
      kernels_.outer(turn(0) + 3 * first, int64_t{3} * p.functions, tape(0) + 3 * first, c_.tape_size(), c_.corrections,
                     3 * (p.function_ptr[b + 1] - first), 3 * (begin - first), 3 * (last - first),
                     bar + int64_t{9} * p.mass_ptr[b]);
      begin = last;
    }
  });
}

#ifdef DIFFVBD_SCALAR
template class CoarseScene<DIFFVBD_SCALAR>;
#else
template class CoarseScene<float>;
template class CoarseScene<double>;
#endif

}  // namespace diffvbd
