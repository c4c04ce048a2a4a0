// What the matrices of a coarse space are made of, from the functions W of each body: the stiffness of a group at rest,
// sum over its tets of W^T K W, and the masses W^T M W; and their transposes (docs/method.md, section 15).
#pragma once

#include <algorithm>
#include <vector>

#include "views.h"

namespace diffvbd::coarse {

template <class T>
struct StiffnessInputs {
  Plan plan;
  const T* weight;                    // [entries], by position
  Batched<const T> mu, lam;           // [1 | B, 1 | tets]  lam >= -2/3 mu
  Batched<const T> gradient, volume;  // [1 | B, tets, 4, 3], [1 | B, tets]
  int64_t scenes, tets;
};

// Sums are double whatever T is: a body may have thousands of tets that nearly cancel.
struct Four {  // three components and one to spare
  double v[4];
  double& operator[](int i) { return v[i]; }
  double operator[](int i) const { return v[i]; }
};
inline void add(Four& to, double scale, const Four& a) {
  for (int i = 0; i < 4; ++i) to.v[i] += scale * a.v[i];
}
inline Four times(double scale, const Four& a) { return {scale * a[0], scale * a[1], scale * a[2], 0}; }
inline double dot(const Four& a, const Four& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
struct Rows {
  Four row[3];
};

// The functions of a group that act on a tet, in ascending order, and their gradients in it.
template <class T>
class Slopes {
 public:
  explicit Slopes(const StiffnessInputs<T>& in) : in_(in), at_(in.plan.width, -1), slope_(in.plan.width) {
    place_.reserve(in.plan.width);
  }
  // tet k of a group
  void find(int64_t scene, int body, int group, int64_t k) {
    const Plan& p = in_.plan;
    slot_ = int64_t{p.block_ptr[body]} * kLanes + p.tet_ptr[group] - p.tet_ptr[p.group_ptr[body]] + k;
    first_ = p.place + p.place_ptr[group] - p.function_ptr[body];
    tet_ = p.tet[slot_];
    place_.clear();
    each([&](int, int place, double) {
      if (at_[place] >= 0) return;
      at_[place] = 0;
      place_.push_back(place);
    });
    std::sort(place_.begin(), place_.end());
    for (int i = 0; i < size(); ++i) at_[place_[i]] = i, slope_[i] = Four{};
    const T* g = in_.gradient.data + scene * in_.gradient.scene + 12 * tet_;
    each([&](int a, int place, double w) {
      Four& to = slope_[at_[place]];
      for (int c = 0; c < 3; ++c) to[c] += w * g[3 * a + c];
    });
    volume = of(in_.volume, scene), mu = of(in_.mu, scene), lam = of(in_.lam, scene);
    for (const int place : place_) at_[place] = -1;
  }
  // f(corner, place among the functions of the group, weight) for all functions at the corners
  template <class F>
  void each(const F& f) const {
    const Plan& p = in_.plan;
    for (int a = 0; a < 4; ++a) {
      const int64_t position = p.corner[(slot_ / kLanes * 4 + a) * kLanes + slot_ % kLanes] / kRow;
      for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
        f(a, first_[p.function[e]], double(in_.weight[e]));
      }
    }
  }
  int size() const { return static_cast<int>(place_.size()); }
  int place(int i) const { return place_[i]; }
  const Four& operator[](int i) const { return slope_[i]; }
  int64_t tet() const { return tet_; }
  double volume, mu, lam;

 private:
  double of(const Batched<const T>& of_tet, int64_t scene) const {
    return of_tet.data[scene * of_tet.scene + tet_ * of_tet.item];
  }
  const StiffnessInputs<T>& in_;
  int64_t slot_ = 0, tet_ = 0;
  const int32_t* first_ = nullptr;
  std::vector<int> at_, place_;
  std::vector<Four> slope_;
};

// `out` [3, 3, width, width] of a group: sum of V (mu (b a^T + (a . b) 1) + lam a b^T) for the gradients a, b of its
// functions.
template <class T>
void stiffness(const StiffnessInputs<T>& in, int64_t scene, int group, T* out) {
  const Plan& p = in.plan;
  const int64_t width = p.width, plane = width * width;
  std::vector<Rows> sum(plane, Rows{});  // from the diagonal on; the spare component of the first row is the trace's
  Slopes<T> s(in);
  for (int32_t k = 0; k < p.tet_ptr[group + 1] - p.tet_ptr[group]; ++k) {
    s.find(scene, p.group_body[group], group, k);
    for (int i = 0; i < s.size(); ++i) {
      const Four shear = times(s.volume * s.mu, s[i]), bulk = times(s.volume * s.lam, s[i]);
      for (int j = i; j < s.size(); ++j) {
        Rows& to = sum[s.place(i) * width + s.place(j)];
        const Four b = s[j];
        for (int r = 0; r < 3; ++r) {
          for (int c = 0; c < 4; ++c) to.row[r][c] += b[r] * shear[c] + bulk[r] * b[c];
        }
        to.row[0][3] += dot(shear, b);
      }
    }
  }
  for (int64_t i = 0; i < width; ++i) {
    for (int64_t j = i; j < width; ++j) {
      const Rows& from = sum[i * width + j];
      for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) {
          const T value = T(from.row[r][c] + (r == c ? from.row[0][3] : 0.0));
          out[(3 * r + c) * plane + i * width + j] = out[(3 * c + r) * plane + j * width + i] = value;
        }
      }
    }
  }
}

// Adjoints of a scene's tets of a group from `bar` [3, 3, width, width]; the last two may be null.
template <class T>
void stiffness_vjp(const StiffnessInputs<T>& in, int64_t scene, int group, const T* bar, T* mu_bar, T* lam_bar,
                   T* gradient_bar, T* volume_bar) {
  const Plan& p = in.plan;
  const int64_t width = p.width, plane = width * width;
  // K is quadratic in the gradients: half of what both sides of the diagonal ask for, h_ij + h_ji^T
  std::vector<Rows> both(plane);
  for (int64_t i = 0; i < width; ++i) {
    for (int64_t j = 0; j < width; ++j) {
      Rows& to = both[i * width + j];
      for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) {
          to.row[r][c] = double(bar[(3 * r + c) * plane + i * width + j]) + bar[(3 * c + r) * plane + j * width + i];
        }
        to.row[r][3] = 0;
      }
      to.row[0][3] = to.row[0][0] + to.row[1][1] + to.row[2][2];
    }
  }
  Slopes<T> s(in);
  std::vector<Four> slope_bar(width);
  for (int32_t k = 0; k < p.tet_ptr[group + 1] - p.tet_ptr[group]; ++k) {
    s.find(scene, p.group_body[group], group, k);
    double shear_sum = 0, bulk_sum = 0;
    for (int i = 0; i < s.size(); ++i) {
      Four shear{}, bulk{};
      for (int j = 0; j < s.size(); ++j) {
        const Four b = s[j];
        const Rows &own = both[s.place(i) * width + s.place(j)], &other = both[s.place(j) * width + s.place(i)];
        add(shear, own.row[0][3], b);
        for (int r = 0; r < 3; ++r) add(shear, b[r], own.row[r]), add(bulk, b[r], other.row[r]);
      }
      shear_sum += 0.5 * dot(shear, s[i]), bulk_sum += 0.5 * dot(bulk, s[i]);
      slope_bar[s.place(i)] = times(s.volume * s.mu, shear);
      add(slope_bar[s.place(i)], s.volume * s.lam, bulk);
    }
    mu_bar[s.tet()] = T(s.volume * shear_sum), lam_bar[s.tet()] = T(s.volume * bulk_sum);
    if (!gradient_bar) continue;
    volume_bar[s.tet()] = T(s.mu * shear_sum + s.lam * bulk_sum);
    Four of_corner[4]{};
    s.each([&](int a, int place, double w) { add(of_corner[a], w, slope_bar[place]); });
    for (int a = 0; a < 4; ++a) {
      for (int c = 0; c < 3; ++c) gradient_bar[12 * s.tet() + 3 * a + c] = T(of_corner[a][c]);
    }
  }
}

// The row of a function in the masses of its body; 1 on the diagonal of one that acts on no vertex. mass [positions].
template <class T>
void mass_row(const Plan& p, const T* weight, const T* row_weight, const T* mass, int function, T* out) {
  const int body = p.function_body[function], first = p.function_ptr[body], count = p.function_ptr[body + 1] - first;
  std::vector<double> sum(count, 0.0);
  for (int32_t r = p.row_ptr[function]; r < p.row_ptr[function + 1]; ++r) {
    const int32_t position = p.row[r];
    for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
      sum[p.function[e] - first] += double(mass[position]) * (double(row_weight[r]) * weight[e]);
    }
  }
  if (p.row_ptr[function] == p.row_ptr[function + 1]) sum[function - first] = 1;
  for (int i = 0; i < count; ++i) out[p.mass_ptr[body] + (function - first) * count + i] = T(sum[i]);
}

// Adjoint of the mass at a position.
template <class T>
T mass_vjp(const Plan& p, const T* weight, const T* bar, int64_t position) {
  const int body = p.position_body[position], first = p.function_ptr[body], count = p.function_ptr[body + 1] - first;
  const T* of_body = bar + p.mass_ptr[body];
  double sum = 0;
  for (int32_t d = p.position_ptr[position]; d < p.position_ptr[position + 1]; ++d) {
    for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
      sum += double(weight[d]) * weight[e] * of_body[(p.function[d] - first) * count + p.function[e] - first];
    }
  }
  return T(sum);
}

}  // namespace diffvbd::coarse
