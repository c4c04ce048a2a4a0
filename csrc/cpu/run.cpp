#include "run.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#include "coarse.h"
#include "contact.h"
#include "kernels.h"
#include "threads.h"

namespace diffvbd {
namespace {

// Text of an error. Not a stream: streams drag in the locale, which breaks where a toolchain links the C++ runtime
// statically beside torch's own.
struct Message {
  std::string text;

  Message& operator<<(const char* a) {
    text += a;
    return *this;
  }
  template <class T, std::enable_if_t<std::is_integral_v<T>, int> = 0>
  Message& operator<<(T a) {
    text += std::to_string(a);
    return *this;
  }
  Message& operator<<(double a) {
    char buffer[32];
    std::snprintf(buffer, sizeof buffer, "%g", a);
    text += buffer;
    return *this;
  }
};

// Below this many blocks in all colors and sweeps of a step, gathering a team costs more than it saves; below this many
// in an average color, its barriers do.
constexpr int64_t kTeamBlocks = 512, kTeamColor = 8;

bool is_padding(const Plan& plan, int64_t slot, int64_t block, int lane) {
  return plan.neighbors[slot * 3 * kLanes + lane] == kRow * (block * kLanes + lane);
}

// Vertex whose values fill a lane: a phantom copies lane 0 of its block, so that it never meets an undefined state.
int32_t source(const Plan& plan, int64_t block, int lane) {
  const int32_t v = plan.order[block * kLanes + lane];
  return v < 0 ? plan.order[block * kLanes] : v;
}

// The place of component c of vertex i in sweep order: in packs [blocks, 3, kLanes], or in rows [blocks kLanes, 4].
constexpr auto in_packs = [](int64_t i, int c) { return (i / kLanes * 3 + c) * kLanes + i % kLanes; };
constexpr auto in_rows = [](int64_t i, int c) { return 4 * i + c; };

template <class T, class Place>
void pack(const Plan& plan, const T* user, T* to, const Place& place, bool phantoms = true) {
  for (int64_t i = 0; i < int64_t{plan.blocks} * kLanes; ++i) {
    const int32_t v = phantoms ? source(plan, i / kLanes, i % kLanes) : plan.order[i];
    for (int c = 0; c < 3; ++c) to[place(i, c)] = v < 0 ? T(0) : user[3 * int64_t{v} + c];
  }
}
template <class T, class Place>
void unpack(const Plan& plan, const T* from, T* user, const Place& place) {
  for (int64_t i = 0; i < int64_t{plan.blocks} * kLanes; ++i) {
    const int32_t v = plan.order[i];
    for (int c = 0; v >= 0 && c < 3; ++c) user[3 * int64_t{v} + c] = from[place(i, c)];
  }
}

// The arrays of one scene in sweep order.
template <class T>
struct Scene {
  Buffer<T> x, y, x_prev, origin, mass, material;
  Buffer<T> contact;
  SceneView<T> view{};
  int64_t data_size;

  Scene(const Plan& plan, const StepInputs<T>& in, int64_t scene, const T* positions)
      : x(size_t(plan.blocks) * kLanes * 4), y(size_t(plan.blocks) * 3 * kLanes), mass(size_t(plan.blocks) * kLanes) {
    const bool lagged = any_x_prev(in.energies, VertexEnergies{});
    pack(plan, positions, x.get(), in_rows);
    pack(plan, in.y.data + scene * in.y.scene, y.get(), in_packs);
    const T* m = in.mass.data + scene * in.mass.scene;
    for (int64_t i = 0; i < int64_t{plan.blocks} * kLanes; ++i) mass.get()[i] = m[source(plan, i / kLanes, i % kLanes)];
    if (lagged) {
      x_prev = Buffer<T>(size_t(plan.blocks) * 3 * kLanes);
      pack(plan, in.x_prev.data + scene * in.x_prev.scene, x_prev.get(), in_packs);
    }
    if (in.origin.data) {
      origin = Buffer<T>(size_t(plan.blocks) * 3 * kLanes);
      pack(plan, in.origin.data + scene * in.origin.scene, origin.get(), in_packs);
    }
    view.x = x.get();
    view.y = y.get();
    view.x_prev = x_prev.get();
    view.origin = origin.get();
    view.mass = mass.get();
    if (in.energies & kElastic) {
      material = Buffer<T>(size_t(plan.slots) * kMaterialScalars * kLanes);
      for (int m = 0; TetLayout::reads_material && m < kMaterialScalars; ++m) {
        for (int64_t i = 0; i < int64_t{plan.slots} * kLanes; ++i) {
          const Batched<const T>& given = in.material[m];
          const int64_t tet = plan.pair[i] >> 2, slot = i / kLanes;
          material.get()[(slot * kMaterialScalars + m) * kLanes + i % kLanes] =
              given.data[scene * given.scene + tet * given.item];
        }
      }
      view.material = material.get();
    }
    if (in.contact) {
      contact = Buffer<T>(size_t(plan.blocks) * kContactScalars * kLanes);
      view.contact = contact.get();
    }
    view.rest = in.rest.data + scene * in.rest.scene;
    view.data = in.data.data + scene * in.data.scene;
    int64_t start = 0;
    for (int k = 0; k < kVertexEnergies; ++k) {
      view.data_start[k] = start;
      view.data_count[k] = in.data_count[k];
      start += int64_t{in.data_count[k]} * (is_per_vertex(k, VertexEnergies{}) ? plan.num_vertices : 1);
    }
    data_size = start;
  }
};

// The place of each vertex in sweep order: the pairs of contact name vertices.
std::vector<int32_t> positions_of(const Plan& plan) {
  std::vector<int32_t> out(plan.num_vertices);
  for (int32_t at = 0; at < plan.blocks * kLanes; ++at) {
    if (plan.order[at] >= 0) out[plan.order[at]] = at;
  }
  return out;
}

template <class F>
void for_scenes(int64_t scenes, bool parallel, const F& f) {
  if (parallel && scenes >= static_cast<int64_t>(torch::stable::get_num_threads())) return for_each(scenes, f, 1);
  for (int64_t i = 0; i < scenes; ++i) f(i);
}
template <class T>
int64_t team_size(const Plan& plan, const StepInputs<T>& in) {
  const int64_t threads = torch::stable::get_num_threads(), blocks = plan.color_block[plan.colors];
  const int64_t passes = in.sweeps + (in.coarse ? in.coarse->corrections : 0);
  if (in.scenes >= threads || blocks * passes < kTeamBlocks || blocks < kTeamColor * plan.colors) return 1;
  return threads;
}

// After the first executed sweep is reversed: what the updates of lower colors have added since a vertex's last turn.
template <class T>
void collect_last(const Plan& plan, const T* rows, T* x_bar) {
  for (int c = 1; c < plan.colors; ++c) {
    const int32_t lower = kRow * plan.block_edge[plan.color_block[c]] * kLanes;  // rows of lower colors come before
    for (int64_t block = plan.color_block[c]; block < plan.color_block[c + 1]; ++block) {
      for (int64_t e = plan.block_incoming[block]; e < plan.block_incoming[block + 1]; ++e) {
        for (int l = 0; l < kLanes; ++l) {
          const int64_t row = plan.incoming[e * kLanes + l];
          if (row >= lower) continue;
          for (int i = 0; i < 3; ++i) x_bar[4 * (block * kLanes + l) + i] += rows[row + i];
        }
      }
    }
  }
}

template <class T>
void look_for_nonfinite(const Plan& plan, const SceneView<T>& s, int64_t step, int sweep, int color, int64_t scene) {
  for (int64_t i = int64_t{plan.color_block[color]} * kLanes; i < int64_t{plan.color_block[color + 1]} * kLanes; ++i) {
    const T* x = s.x + 4 * i;
    if (plan.order[i] < 0 || (std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]))) continue;
    Message out;
    out << "non-finite position in step " << step << ", sweep " << sweep << ", color " << color << ", vertex "
        << plan.order[i] << ", scene " << scene << ": (" << x[0] << ", " << x[1] << ", " << x[2] << ")";
    throw std::runtime_error(out.text);
  }
}

// --- values that a step cannot work with, found before any work is done

template <class T>
int64_t distinct_scenes(const Batched<const T>& t, int64_t scenes) {
  return t.scene == 0 ? std::min<int64_t>(scenes, 1) : scenes;
}

template <class Law, class T>
void check_material(const StepInputs<T>& in, int64_t tets) {
  const int64_t distinct = one_for_scenes(in.material) ? std::min<int64_t>(in.scenes, 1) : in.scenes;
  const int64_t count = one_for_items(in.material) ? std::min<int64_t>(tets, 1) : tets;
  for (int64_t b = 0; b < distinct; ++b) {
    for (int64_t i = 0; i < count; ++i) {
      T material[kMaterialScalars];
      for (int m = 0; m < kMaterialScalars; ++m) {
        material[m] = in.material[m].data[b * in.material[m].scene + i * in.material[m].item];
      }
      for (int m = 0; m < kMaterialScalars; ++m) {
        const char* message = Law::invalid(material, m);
        if (!message) continue;
        Message out;
        out << message << ", got " << material[m];
        for (int other = 0; other < m; ++other) out << " with " << Law::material_names[other] << " " << material[other];
        out << " at tet " << i << " of scene " << b;
        throw std::invalid_argument(out.text);
      }
    }
  }
}

template <class T>
void check_vectors(const char* name, const Batched<const T>& t, int64_t scenes, int64_t vertices) {
  for (int64_t b = 0; b < distinct_scenes(t, scenes); ++b) {
    for (int64_t i = 0; i < 3 * vertices; ++i) {
      const T value = t.data[b * t.scene + i];
      if (std::isfinite(value)) continue;
      Message out;
      out << name << ": expected finite values, got " << value << " at vertex " << i / 3 << " of scene " << b;
      throw std::invalid_argument(out.text);
    }
  }
}

template <class T>
void check_energy_data(const Plan& plan, const StepInputs<T>& in) {
  for (int64_t b = 0; b < distinct_scenes(in.data, in.scenes); ++b) {
    const T* at = in.data.data + b * in.data.scene;
    for (int k = 0; k < kVertexEnergies; ++k) {
      const int64_t size = int64_t{in.data_count[k]} * (is_per_vertex(k, VertexEnergies{}) ? plan.num_vertices : 1);
      const int stride = data_stride(k, VertexEnergies{});
      for (int64_t i = 0; i < size; i += stride) {
        const char* message = invalid_data(k, at + i, VertexEnergies{});
        for (int64_t c = i; !message && c < i + stride; ++c) {
          if (!std::isfinite(at[c])) message = "parameters: expected finite values";
        }
        if (!message) continue;
        Message out;
        out << message << ", got (";
        for (int64_t c = i; c < i + stride; ++c) out << (c > i ? ", " : "") << at[c];
        out << ") in record " << i / stride << " of scene " << b;
        throw std::invalid_argument(out.text);
      }
      at += size;
    }
  }
}

// The step filter needs a positive gap to start from.
template <class T>
void check_above_planes(const Plan& plan, const StepInputs<T>& in) {
  for (int64_t b = 0; b < in.scenes; ++b) {
    const T* planes = in.data.data + b * in.data.scene;
    for (int k = 0; k < in.data_count[0]; k += FloorBarrier::stride) {
      std::vector<int32_t> below;
      for (int64_t i = 0; i < int64_t{plan.color_block[plan.colors]} * kLanes; ++i) {
        const int32_t v = plan.order[i];
        if (v < 0) continue;
        const auto at = [&](const Batched<const T>& t) {
          const T* a = t.data + b * t.scene + 3 * int64_t{v};
          return vector_at(a);
        };
        VertexState<T> state{at(in.x_prev), zero3<T>(), zero3<T>(), T(0)};
        if (in.origin.data) state.origin = at(in.origin);
        const FloorBarrier::Plane<T> plane(planes + k, state);
        if (T(0) < plane.gap(state.x)) continue;
        below.push_back(v);
      }
      if (below.empty()) continue;
      std::sort(below.begin(), below.end());
      Message out;
      out << "x: expected every unpinned vertex above floor plane " << k / FloorBarrier::stride << ", got "
          << below.size() << " on or below it in scene " << b << ": vertices ";
      for (size_t i = 0; i < std::min<size_t>(below.size(), 5); ++i) out << (i > 0 ? ", " : "") << below[i];
      if (below.size() > 5) out << ", ...";
      throw std::invalid_argument(out.text);
    }
  }
}

}  // namespace

template <class T>
void check_values(const Plan& plan, const StepInputs<T>& in) {
  const int64_t n = plan.num_vertices;
  check_vectors("x", in.x_prev, in.scenes, n);
  check_vectors("predictor (x, v, force, gravity, prescribed)", in.y, in.scenes, n);
  check_vectors("start (x, v, force, gravity, prescribed)", in.x_start, in.scenes, n);
  if (in.energies & kExactBlock) check_material<ElasticLaw<true>>(in, plan.num_tets);
  if (in.energies & kPaperBlock) check_material<ElasticLaw<false>>(in, plan.num_tets);
  // Vertices that no sweep moves need no mass: an isolated vertex has none.
  for (int64_t b = 0; b < distinct_scenes(in.mass, in.scenes); ++b) {
    for (int64_t i = 0; i < int64_t{plan.color_block[plan.colors]} * kLanes; ++i) {
      const int32_t v = plan.order[i];
      if (v < 0) continue;
      const T m = in.mass.data[b * in.mass.scene + v];
      if (m > 0 && std::isfinite(m)) continue;
      Message out;
      out << "density or rest_points: expected a finite mass > 0 kg, got " << m << " at vertex " << v << " of scene "
          << b;
      throw std::invalid_argument(out.text);
    }
  }
  check_energy_data(plan, in);
  if (any_filter(in.energies, VertexEnergies{})) check_above_planes(plan, in);
}

template <class T>
void check_masses(const T* fractions, int64_t scenes, int64_t tets, int64_t stride) {
  for (int64_t i = 0; i < scenes * tets; ++i) {
    const T mass = 4 * fractions[i * stride];
    if (mass > 0 && std::isfinite(mass)) continue;
    Message out;
    out << "density or rest_points: expected density > 0 kg/m^3 and positive volume, got a mass of " << mass
        << " kg at tet " << i % tets << " of scene " << i / tets;
    throw std::invalid_argument(out.text);
  }
}

template <class T>
void run_forward(const Plan& plan, const StepInputs<T>& in, T* x, T* tape, uint8_t* truncations) {
  const auto kernel = forward_kernel<T>(in.energies);
  const int64_t tape_size = int64_t{in.sweeps} * tape_rows(in.tape_policy, kept_scalars(in.energies)) * plan.num_active;
  const std::vector<int32_t> position = in.contact ? positions_of(plan) : std::vector<int32_t>{};
  const int every = in.coarse ? in.coarse->plan.every : 0, begun = in.coarse ? in.coarse->plan.begun : 0;
  // a message thrown inside a parallel region would be lost
  const bool looks = in.debug_step >= 0;
  for_scenes(in.scenes, !looks, [&](int64_t b) {
    Scene<T> scene(plan, in, b, in.x_start.data + b * in.x_start.scene);
    scene.view.tape = tape + b * tape_size;
    std::optional<ContactScene<T>> contact;
    if (in.contact) {
      contact.emplace(plan, *in.contact, position.data(), b, scene.view, in.parameters.time_step, nullptr);
    }
    std::optional<CoarseScene<T>> coarse;
    if (in.coarse) coarse.emplace(plan, in, b, scene.view);
    Team::run(looks ? 1 : team_size(plan, in), [&](Team::Member member) {
      int corrections = 0;
      for (int k = 0; k <= in.sweeps; ++k) {
        if (coarse && coarse::corrects_before(k, in.sweeps, every, begun)) {
          coarse->correct(corrections++, member);
          for (int c = 0; looks && c < plan.colors; ++c) look_for_nonfinite(plan, scene.view, in.debug_step, k, c, b);
        }
        if (k == in.sweeps) break;
        const StepParameters<T> q = of_sweep(in.parameters, k + 1 == in.sweeps);
        if (contact && k == 1) contact->settle(member);
        for (int c = 0; c < plan.colors; ++c) {
          const int64_t first = plan.color_block[c], last = plan.color_block[c + 1];
          if (contact) {
            member.each_sync(first, last, [&](int64_t begin, int64_t end) {
              contact->assemble(begin, end);
              contact->remember(begin, end);
            });
          }
          uint8_t* limits = contact ? truncations + (b * in.sweeps + k) * plan.num_vertices : nullptr;
          member.each_sync(first, last, [&](int64_t begin, int64_t end) {
            kernel(plan, scene.view, q, k, in.tape_policy, begin, end);
            if (contact) contact->propose(first, last, begin, end, limits);
          });
          if (contact) {
            member.each_sync(first, last, [&](int64_t begin, int64_t end) { contact->search(begin, end); });
            member.each_sync(first, last,
                             [&](int64_t begin, int64_t end) { contact->limit(first, last, begin, end, limits); });
          }
          if (looks) look_for_nonfinite(plan, scene.view, in.debug_step, k, c, b);
        }
      }
    });
    unpack(plan, scene.view.x, x + b * 3 * int64_t{plan.num_vertices}, in_rows);
  });
}

template <class T>
void run_reverse(const Plan& plan, const StepInputs<T>& in, const T* x, const T* x_bar, const T* tape,
                 const uint8_t* limits, const StepAdjoints<T>& out) {
  const bool wants_material = out.material[0] != nullptr;
  const auto kernel = reverse_kernel<T>(in.energies);
  const int64_t rows_of_tape = tape_rows(in.tape_policy, kept_scalars(in.energies));
  const int64_t tape_size = in.sweeps * rows_of_tape * plan.num_active;
  const int64_t n = plan.num_vertices, tets = plan.num_tets, lanes = int64_t{plan.blocks} * kLanes;
  const int64_t pairs = int64_t{plan.slots} * kLanes;
  const std::vector<int32_t> position = in.contact ? positions_of(plan) : std::vector<int32_t>{};
  for_scenes(in.scenes, true, [&](int64_t b) {
    Scene<T> scene(plan, in, b, x + b * 3 * n);
    SceneView<T>& s = scene.view;
    s.tape = const_cast<T*>(tape) + b * tape_size;
    const Buffer<T> x_rows(4 * lanes), y_bar(3 * lanes, true), mass_bar(lanes, true),
        rows(4 * (int64_t{plan.edge_slots} * kLanes + 1), true);
    const Buffer<T> x_prev_bar(s.x_prev ? 3 * lanes : 0, true),
        material_bar(wants_material ? kMaterialScalars * pairs : 0, true),
        rest_bar(out.rest ? kPairRest * pairs : 0, true), data_bar(out.data ? kMaxEnergyData * lanes : 0, true);
    pack(plan, x_bar + b * 3 * n, x_rows.get(), in_rows, false);
    s.x_bar = x_rows.get();
    s.y_bar = y_bar.get();
    s.x_prev_bar = x_prev_bar.get();
    s.mass_bar = mass_bar.get();
    s.rows = rows.get();
    s.material_bar = material_bar.get();
    s.rest_bar = rest_bar.get();
    s.data_bar = data_bar.get();
    const Buffer<T> turn(in.contact ? 6 * lanes : 0), limit(in.contact ? lanes : 0);
    s.turn = turn.get();
    s.limit = limit.get();
    std::optional<ContactScene<T>> contact;
    if (in.contact) {
      contact.emplace(plan, *in.contact, position.data(), b, s, in.parameters.time_step, out.contact);
    }

    std::optional<CoarseScene<T>> coarse;
    if (in.coarse) coarse.emplace(plan, in, b, s);
    const int every = in.coarse ? in.coarse->plan.every : 0, begun = in.coarse ? in.coarse->plan.begun : 0;

    const auto sweep_back = [&](int k, Team::Member& member) {
      const StepParameters<T> q = of_sweep(in.parameters, k + 1 == in.sweeps);
      for (int c = plan.colors - 1; c >= 0; --c) {
        const int64_t first = plan.color_block[c], last = plan.color_block[c + 1];
        if (contact) {
          member.each_sync(first, last, [&](int64_t begin, int64_t end) {
            contact->prepare(k, rows_of_tape, begin, end, limits + (b * in.sweeps + k) * n);
          });
          member.each(first, last, [&](int64_t begin, int64_t end) { contact->search(begin, end); });
          if (in.tape_policy != kFullTape) {
            member.barrier();
            member.each_sync(first, last, [&](int64_t begin, int64_t end) { contact->assemble(begin, end); });
          }
        }
        member.each_sync(first, last,
                         [&](int64_t begin, int64_t end) { kernel(plan, s, q, k, in.tape_policy, begin, end); });
        if (contact) member.each_sync(first, last, [&](int64_t begin, int64_t end) { contact->reverse(begin, end); });
      }
      // Pinned vertices have no turn of their own: they collect after each sweep, before the rows are overwritten.
      member.each_sync(plan.color_block[plan.colors], plan.blocks, [&](int64_t begin, int64_t end) {
        for (int64_t block = begin; block < end; ++block) {
          store_rows(s.x_bar, block, load_rows(s.x_bar, block) + pull_rows(plan, s.rows, block));
        }
      });
    };
    Team::run(team_size(plan, in), [&](Team::Member member) {
      int corrections = in.coarse ? in.coarse->corrections : 0;
      for (int k = in.sweeps; k >= 0; --k) {
        if (k < in.sweeps) sweep_back(k, member);
        if (coarse && coarse::corrects_before(k, in.sweeps, every, begun)) coarse->reverse(--corrections, member);
      }
      if (coarse) coarse->finish(member);
    });
    collect_last(plan, s.rows, s.x_bar);
    if (contact) contact->finish(out.collider + b * 3 * (in.contact->corners - n));
    unpack(plan, s.x_bar, out.x_start + b * 3 * n, in_rows);
    unpack(plan, s.y_bar, out.y + b * 3 * n, in_packs);
    if (s.x_prev) unpack(plan, s.x_prev_bar, out.x_prev + b * 3 * n, in_packs);
    if (out.mass) {
      for (int64_t i = 0; i < lanes; ++i) {
        if (plan.order[i] >= 0) out.mass[b * n + plan.order[i]] = s.mass_bar[i];
      }
    }
    // Each tet's four pairs are added in the order of the slots, whatever the number of threads.
    for (int64_t block = 0; (wants_material || out.rest) && block < plan.blocks; ++block) {
      for (int64_t slot = plan.block_slot[block]; slot < plan.block_slot[block + 1]; ++slot) {
        for (int l = 0; l < kLanes; ++l) {
          if (is_padding(plan, slot, block, l)) continue;
          const int64_t tet = plan.pair[slot * kLanes + l] >> 2;
          const int local = plan.pair[slot * kLanes + l] & 3;
          for (int m = 0; wants_material && m < kMaterialScalars; ++m) {
            out.material[m][b * tets + tet] += s.material_bar[(slot * kMaterialScalars + m) * kLanes + l];
          }
          for (int i = 0; out.rest && i < kPairRest; ++i) {
            out.rest[(b * tets + tet) * kRestScalars + TetLayout::rest_index(local, i)] +=
                s.rest_bar[(slot * kPairRest + i) * kLanes + l];
          }
        }
      }
    }
    if (out.data) {
      T* data = out.data + b * scene.data_size;
      int row = 0;
      for (int e = 0; e < kVertexEnergies; ++e) {
        const bool per_vertex = is_per_vertex(e, VertexEnergies{});
        for (int i = 0; i < s.data_count[e]; ++i, ++row) {
          for (int64_t at = 0; at < lanes; ++at) {
            const int32_t v = plan.order[at];
            if (v < 0) continue;
            data[s.data_start[e] + (per_vertex ? int64_t{v} * s.data_count[e] : 0) + i] += s.data_bar[row * lanes + at];
          }
        }
      }
    }
  });
}

template <class T>
void pack_rest(const Plan& plan, const T* rest, T* packed) {
  for (int64_t t = 0; t < plan.num_tets; ++t) {
    const T volume = TetLayout::volume(rest + t * kRestScalars);
    if (volume > 0 && std::isfinite(volume)) continue;
    Message out;
    out << "rest_points: expected tets of positive volume, got " << volume << " m^3 at tet " << t;
    throw std::invalid_argument(out.text);
  }
  int at[4][kPairRest];
  for (int i = 0; i < 4 * kPairRest; ++i)
    at[i / kPairRest][i % kPairRest] = TetLayout::rest_index(i / kPairRest, i % kPairRest);
  for (int64_t block = 0; block < plan.blocks; ++block) {
    for (int64_t slot = plan.block_slot[block]; slot < plan.block_slot[block + 1]; ++slot) {
      for (int l = 0; l < kLanes; ++l) {
        T* out = packed + slot * kPairRest * kLanes + l;
        const bool padding = is_padding(plan, slot, block, l);
        const int32_t pair = plan.pair[slot * kLanes + l];
        const T* row = rest + int64_t{pair >> 2} * kRestScalars;
        const int local = pair & 3;
        for (int i = 0; i < kPairRest; ++i) {
          out[i * kLanes] = padding && i < TetLayout::pair_shape ? T(0) : row[at[local][i]];
        }
      }
    }
  }
}

#define DIFFVBD_INSTANTIATE(T)                                                                                  \
  template void check_masses<T>(const T*, int64_t, int64_t, int64_t);                                           \
  template void check_values<T>(const Plan&, const StepInputs<T>&);                                             \
  template void run_forward<T>(const Plan&, const StepInputs<T>&, T*, T*, uint8_t*);                            \
  template void run_reverse<T>(const Plan&, const StepInputs<T>&, const T*, const T*, const T*, const uint8_t*, \
                               const StepAdjoints<T>&);                                                         \
  template void pack_rest<T>(const Plan&, const T*, T*);
#ifdef DIFFVBD_SCALAR
DIFFVBD_INSTANTIATE(DIFFVBD_SCALAR)
#else
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#endif

}  // namespace diffvbd
