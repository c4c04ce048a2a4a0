// Host side of a step: workspace and launches.
#pragma once

#include <algorithm>

#include "coarse.h"
#include "frame.cuh"
#include "schedule.cuh"
#include "step.h"

namespace diffvbd::cuda {
namespace {

constexpr size_t kBarrierBytes = 256;
// Hands out the arrays of a workspace; without memory it counts their scalars.
template <class T>
struct Carver {
  T* base;
  int64_t used = 0;
  T* operator()(bool wanted, int64_t scalars) {
    if (!wanted) return nullptr;
    T* here = base + used;
    used += (scalars + 3) / 4 * 4;  // rows stay aligned
    return here;
  }
};

// scenes: worked on at once.
template <class T>
CoarseWork<T> carve_coarse(const coarse::Inputs<T>& in, int64_t positions, int64_t scenes, bool reverse,
                           Carver<T>& take) {
  const coarse::Plan& p = in.plan;
  const auto bytes = [](int64_t count, size_t size) { return static_cast<int64_t>(count * size / sizeof(T) + 1); };
  CoarseWork<T> w{};
  w.gradient = take(true, scenes * kRow * positions);
  w.displacement = take(true, scenes * kRow * positions);
  w.restricted = take(true, scenes * 3 * p.functions);
  w.solved = take(reverse, scenes * in.corrections * 3 * p.functions);
  w.wanted = take(reverse && in.has_vertex_blocks, scenes * kRow * positions);
  w.inverse = take(in.has_vertex_blocks, scenes * 9 * p.cells);
  const auto doubles = [&](int64_t count) {
    return reinterpret_cast<double*>(take(in.has_vertex_blocks, bytes(scenes * count, sizeof(double))));
  };
  w.vertex_blocks = doubles(6 * positions);
  w.matrix = {nullptr, doubles(int64_t{9} * p.cells), doubles(int64_t{6} * p.functions * kEdge),
              doubles(int64_t{kEdge} * kEdge * p.bodies)};
  w.sums = reinterpret_cast<double*>(take(!reverse, bytes(scenes * p.parts * coarse::kDegree, sizeof(double))));
  w.failures = reinterpret_cast<int32_t*>(take(!reverse, bytes(scenes * p.bodies, sizeof(int32_t))));
  return w;
}

// Arrays that start from zero come first; `zeroed` receives their scalars.
template <class T>
Workspace<T> carve(const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints, const Choice& choice,
                   Carver<T>& take, int64_t* zeroed, T** spill, CoarseWork<T>& coarse) {
  const GroupPlan& plan = host.plan;
  const int64_t n = choice.chunk, positions = int64_t{plan.blocks} * kSlice, pairs = int64_t{plan.slots} * kSlice;
  const bool elastic = (in.energies & kElastic) != 0, reverse = adjoints != nullptr;
  const bool lagged = any_x_prev(in.energies, VertexEnergies{});
  const bool one = one_for_items(in.material);
  int scalars = 0;
  for (int k = 0; k < kVertexEnergies; ++k) scalars += in.data_count[k];
  Workspace<T> w{};
  w.rows = take(reverse, n * (int64_t{plan.edge_slots} * kSlice + 1) * kRow);
  w.y_bar = take(reverse, n * 3 * positions);
  w.x_prev_bar = take(reverse && lagged, n * 3 * positions);
  w.mass_bar = take(reverse && adjoints->mass, n * positions);
  w.material_bar = take(elastic && (choice.wanted & kMaterial), n * kMaterialScalars * (one ? positions : pairs));
  w.rest_bar = take(elastic && (choice.wanted & kRest), n * kPairRest * pairs);
  w.data_bar = take(reverse && adjoints->data, n * scalars * positions);
  *zeroed = take.used;
  w.x = take(true, n * kRow * positions);
  w.x_bar = take(reverse, n * kRow * positions);
  w.y = take(true, n * 3 * positions);
  w.x_prev = take(lagged, n * 3 * positions);
  w.origin = take(in.origin.data != nullptr, n * 3 * positions);
  w.mass = take(true, (in.mass.scene != 0 ? n : 1) * positions);
  w.material = take(elastic && !one, (one_for_scenes(in.material) ? 1 : n) * kMaterialScalars * pairs);
  const bool cooperative =
      possible_lanes<T>(host, choice, choice.lanes, reverse) == kManyLanes;  // blocks keep pair terms to themselves
  w.contact = take(in.contact && !cooperative, n * kContactScalars * positions);
  w.moved = take(!reverse && in.contact, n * kRow * positions);
  w.reversed = take(reverse && in.contact, n * 6 * positions);
  w.position = reinterpret_cast<int32_t*>(take(in.contact != nullptr, plan.num_vertices));
  *spill = nullptr;
  if (possible_lanes<T>(host, choice, choice.lanes, reverse) == kSpillLanes) {
    const int64_t warps = int64_t{choice.multiprocessors} * kWarpsPerBlock;
    *spill = take(true, warps * shared_scalars<T>(host.degree, host.valence, 0, kSpillLanes, reverse));
  }
  coarse = {};
  if (in.coarse) coarse = carve_coarse(*in.coarse, positions, n, reverse, take);
  return w;
}

template <class T>
struct Runner {
  const HostPlan& host;
  const StepInputs<T>& in;
  const StepAdjoints<T>* adjoints;
  const Choice& choice;
  cudaStream_t stream;
  unsigned* barrier;
  StepView<T> s{};
  int64_t zeroed = 0;
  T* first = nullptr;
  bool material_is_shared;
  CoarseWork<T> coarse{};
  ContactView<T> contact{};

  Runner(const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints, const Choice& choice,
         void* workspace, cudaStream_t stream)
      : host(host),
        in(in),
        adjoints(adjoints),
        choice(choice),
        stream(stream),
        barrier(static_cast<unsigned*>(workspace)) {
    first = reinterpret_cast<T*>(static_cast<char*>(workspace) + kBarrierBytes);
    Carver<T> take{first};
    s.w = carve(host, in, adjoints, choice, take, &zeroed, &s.spill, coarse);
    s.plan = host.plan;
    s.positions = int64_t{host.plan.blocks} * kSlice;
    s.degree = host.degree;
    s.valence = host.valence;
    s.own = choice.regime == kBlock;
    s.parameters = in.parameters;
    s.sweeps = in.sweeps;
    s.tape_policy = in.tape_policy;
    s.tape_rows = tape_rows(in.tape_policy, kept_scalars(in.energies));
    s.has_tets = (in.energies & kElastic) != 0;
    s.one_material = one_for_items(in.material);
    s.mass = {s.w.mass, in.mass.scene != 0 ? s.positions : 0, 1};
    if (in.contact) contact.in = *in.contact;
    if (in.contact && adjoints) contact.slots = *adjoints->contact;
    material_is_shared = one_for_scenes(in.material);
    s.material_scene = material_is_shared ? 0 : int64_t{host.plan.slots} * kSlice * kMaterialScalars;
    int64_t start = 0;
    for (int k = 0; k < kVertexEnergies; ++k) {
      s.data_start[k] = start;
      s.data_count[k] = in.data_count[k];
      s.data_row[k] = s.data_scalars;
      s.data_scalars += in.data_count[k];
      start += int64_t{in.data_count[k]} * (is_per_vertex(k, VertexEnergies{}) ? host.plan.num_vertices : 1);
    }
  }

  // Selects the scenes [base, base + count) of the batch.
  void choose(int64_t base, int64_t count, T* tape) {
    const auto at = [&](const Batched<const T>& t) {
      return Batched<const T>{t.data + base * t.scene, t.scene, t.item};
    };
    s.scenes = count;
    s.base = base;
    s.rest = at(in.rest);
    for (int m = 0; m < kMaterialScalars; ++m) s.material[m] = at(in.material[m]);
    s.data = at(in.data);
    s.tape = tape + base * in.sweeps * s.tape_rows * host.plan.num_active;
  }

  template <class... P, class... A>
  cudaError_t per_item(void (*kernel)(P...), int64_t items, A... arguments) {
    if (items == 0) return cudaSuccess;
    void* pointers[] = {&arguments...};
    const unsigned blocks = blocks_for(items, kFrameThreads);
    return cudaLaunchKernel(reinterpret_cast<const void*>(kernel), dim3(blocks), dim3(kFrameThreads), pointers, 0,
                            stream);
  }

  cudaError_t load(int64_t base, const T* ends, const T* x_bar, const T* v_bar) {
    if (s.w.material && (base == 0 || !material_is_shared)) {
      const int64_t scenes = material_is_shared ? 1 : s.scenes;
      const int64_t items = scenes * host.plan.slots * kSlice;
      if (auto error = per_item(load_material<T>, items, in, s, base, scenes)) return error;
    }
    if (auto error = per_item(load_vertices<T>, s.scenes * s.positions, in, s, base, ends, x_bar, v_bar, barrier)) {
      return error;
    }
    return cudaSuccess;
  }

  ContactPasses<T> passes() const { return {s, contact, stream}; }

  int64_t blocks_of(int color) const { return host.color_block[color + 1] - host.color_block[color]; }

  cudaError_t sweep(SweepKernel function, int lanes, bool backward) {
    const int colors = host.plan.colors;
    if (colors == 0) return cudaSuccess;
    int64_t most = 1;
    for (int c = 0; c < colors; ++c) most = std::max(most, blocks_of(c) * threads_of(lanes));
    const bool cooperative =
        in.contact && lanes == kManyLanes;  // a block for each vertex, whose first warp has its star
    const int regime = in.contact && !cooperative ? kColor : choice.regime;
    const bool own = regime == kBlock, spills = lanes == kSpillLanes;
    const auto shared_of_warp = [&](int stages) -> size_t {
      return spills ? 0 : shared_scalars<T>(host.degree, host.valence, stages, lanes, backward) * sizeof(T);
    };
    s.stages = has_stages(lanes, backward) ? kFewStages : 0;
    int64_t warps = own && !spills ? std::min<int64_t>(kMaxThreads / kSlice, most) : kWarpsPerBlock;
    const size_t room = choice.shared - choice.by_pairs;
    if (const size_t one = shared_of_warp(s.stages)) warps = std::min<int64_t>(warps, room / one);
    if (cooperative) warps = 1;
    size_t shared = shared_of_warp(s.stages) * warps;
    const size_t with_many_stages = s.stages > 0 ? shared_of_warp(kManyStages) * warps : 0;
    if (std::max(shared, with_many_stages) + choice.by_pairs > 48 * 1024) {
      const auto attribute = cudaFuncAttributeMaxDynamicSharedMemorySize;
      // always the same limit: other threads may launch the same kernel
      if (auto error = cudaFuncSetAttribute(function, attribute, static_cast<int>(room))) return error;
    }
    const dim3 threads(static_cast<unsigned>((cooperative ? kCooperativeWarps : warps) * kSlice));
    Range range{regime, 0, 0, 0, colors, barrier};
    void* arguments[] = {&s, &range, &contact};
    // spilled stars: no more blocks than have memory
    const auto blocks_for = [&](int64_t parts) {
      const int64_t needed = own ? s.scenes : (parts * s.scenes + warps - 1) / warps;
      return spills ? std::min<int64_t>(needed, choice.multiprocessors) : needed;
    };
    int resident = 0;
    const auto occupancy = [&](size_t bytes) {
      const int size = static_cast<int>(threads.x);
      return cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, function, size, bytes);
    };
    if (s.stages > 0 && s.one_material && with_many_stages <= room) {  // materials of tets need the L1 cache
      const int64_t each = (blocks_for(most) + choice.multiprocessors - 1) / choice.multiprocessors;
      if (auto error = occupancy(shared)) return error;
      const int64_t with_few = std::min<int64_t>(resident, each);
      if (auto error = occupancy(with_many_stages)) return error;
      const int64_t with_many = std::min<int64_t>(resident, each);
      const bool leaves_cache = with_many * with_many_stages <= choice.shared / 8 * 7;
      if (with_many == with_few && leaves_cache) s.stages = kManyStages, shared = with_many_stages;
    }
    const bool may_depend = regime == kColor && can_depend(function);
    const auto start = [&](int64_t blocks, bool dependent = false) {
      return launch(function, static_cast<unsigned>(blocks), threads, arguments, shared, stream, dependent);
    };
    const auto run = [&](int begin, int end) {  // in the reverse counted from the last
      range.first_sweep = begin, range.end_sweep = end;
      range.first_color = 0, range.end_color = colors;
      if (begin == end) return cudaSuccess;
      if (own) return start(blocks_for(most));
      if (regime == kColor) return color_by_color(range, backward, lanes, may_depend, blocks_for, start);
      if (auto error = occupancy(shared)) return error;
      const int64_t blocks = std::min<int64_t>(int64_t{resident} * choice.multiprocessors, blocks_for(most));
      const auto error = cudaLaunchCooperativeKernel(function, dim3(static_cast<unsigned>(blocks)), threads, arguments,
                                                     shared, stream);
      if (in.contact && !backward && (end - begin) % 2 != 0) std::swap(s.w.x, s.w.moved);
      return error;
    };
    return in.coarse ? corrected(run, backward) : run(0, in.sweeps);
  }

  // Sweeps with the corrections between them.
  template <class Run>
  cudaError_t corrected(const Run& run, bool backward) {
    const coarse::Inputs<T>& c = *in.coarse;
    const Corrections<T> corrections{host, choice, s, in, coarse, barrier, stream};
    int done = 0, number = backward ? c.corrections : 0;
    for (int i = 0; i <= in.sweeps; ++i) {
      const int sweep = backward ? in.sweeps - i : i;
      if (!coarse::corrects_before(sweep, in.sweeps, c.plan.every, c.plan.begun)) continue;
      if (auto error = run(done, i)) return error;
      const auto error = backward ? corrections.reverse(--number, choice.wanted) : corrections.correct(number++);
      if (error != cudaSuccess) return error;
      done = i;
    }
    if (auto error = run(done, in.sweeps)) return error;
    return backward ? corrections.matrix_bars() : cudaSuccess;
  }

  // Every launch but the first depends on the one before.
  template <class Blocks, class Start>
  cudaError_t color_by_color(Range& range, bool backward, int lanes, bool may_depend, const Blocks& blocks_for,
                             const Start& start) {
    bool dependent = false;
    cudaError_t error = cudaSuccess;
    const bool apart = in.contact && lanes != kManyLanes;  // with passes before and after the updates
    const bool full = backward && in.tape_policy == kFullTape;
    const int colors = host.plan.colors, first = range.first_sweep, last = range.end_sweep;
    for (int k = first; k < last; ++k) {
      for (int c = 0; c < colors; ++c) {
        range.first_sweep = k, range.end_sweep = k + 1;
        range.first_color = c, range.end_color = c + 1;
        const int color = backward ? colors - 1 - c : c;
        if (blocks_of(color) == 0) continue;
        const int64_t begin = host.color_block[color], end = host.color_block[color + 1];
        const auto pass = [&](bool wanted, const auto& launched) {
          if (!wanted || error != cudaSuccess) return;
          error = launched();
          dependent = may_depend;
        };
        const int sweep = backward ? in.sweeps - 1 - k : -1;
        pass(apart && backward, [&] { return passes().prepare(begin, end, dependent); });
        pass(apart && !full, [&] { return passes().assemble(sweep, begin, end, dependent); });
        pass(true, [&] { return start(blocks_for(blocks_of(color) * threads_of(lanes)), dependent); });
        pass(apart && !backward, [&] { return passes().limit(k, begin, end, dependent); });
        pass(in.contact && backward, [&] { return passes().reverse(!apart, begin, end, dependent); });
        if (error != cudaSuccess) return error;
      }
      if (in.contact && !backward) std::swap(s.w.x, s.w.moved);
    }
    return cudaSuccess;
  }

  cudaError_t store(int64_t base, const StepAdjoints<T>& out) {
    if (in.contact) {
      if (auto error = passes().collect(out)) return error;
    }
    if (auto error = per_item(store_adjoints<T>, s.scenes * s.positions, in, s, base, out)) return error;
    const bool material = out.material[0] != nullptr, per_tet = material && !s.one_material;
    if (per_tet || s.w.rest_bar) {
      const int64_t items = s.scenes * host.plan.num_tets;
      if (auto error = per_item(store_tets<T>, items, s, base, out, per_tet)) return error;
    }
    for (int m = 0; material && s.one_material && m < kMaterialScalars; ++m) {
      const int64_t stride = kMaterialScalars * s.positions;
      if (auto error = sum(s.w.material_bar + m, stride, kMaterialScalars, s.scenes, out.material[m] + base, 1)) {
        return error;
      }
    }
    for (int k = 0; out.data && k < kVertexEnergies; ++k) {
      if (is_per_vertex(k, VertexEnergies{})) continue;
      for (int i = 0; i < s.data_count[k]; ++i) {
        T* to = out.data + base * in.data_size + s.data_start[k] + i;
        const T* from = s.w.data_bar + (s.data_row[k] + i) * s.positions;
        if (auto error = sum(from, s.data_scalars * s.positions, 1, s.scenes, to, in.data_size)) return error;
      }
    }
    return in.contact ? passes().store(out) : cudaSuccess;
  }

  cudaError_t sum(const T* values, int64_t stride, int64_t step, int64_t rows, T* out, int64_t out_stride) {
    int64_t count = s.positions;
    void* arguments[] = {&values, &stride, &step, &count, &out, &out_stride};
    const auto kernel = reinterpret_cast<const void*>(sum_rows<T>);
    return cudaLaunchKernel(kernel, dim3(static_cast<unsigned>(rows)), dim3(kFrameThreads), arguments, 0, stream);
  }
};

template <class T, int wanted>
SweepKernel reverse_kernel_for(int energies, int lanes) {
  if constexpr (!kOwnLaw) {
    if (lanes == kFewLanes) return reverse_kernel<T, wanted, kFewLanes>(energies);
  }
  if (lanes == kSomeReverseLanes) return reverse_kernel<T, wanted, kSomeReverseLanes>(energies);
  return lanes == kManyLanes ? reverse_kernel<T, wanted, kManyLanes>(energies)
                             : reverse_kernel<T, wanted, kSpillLanes>(energies);
}
template <class T>
SweepKernel reverse_kernel_for(int energies, int wanted, int lanes) {
  if constexpr (!kOwnLaw) {
    if (!(wanted & kMaterial)) return reverse_kernel_for<T, kState>(energies, lanes);
    if (!(wanted & kRest)) return reverse_kernel_for<T, kMaterial>(energies, lanes);
  }
  return reverse_kernel_for<T, kAllAdjoints>(energies, lanes);
}

}  // namespace

template <class T>
size_t workspace_bytes(const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints,
                       const Choice& choice) {
  Carver<T> take{nullptr};
  int64_t zeroed = 0;
  T* spill = nullptr;
  CoarseWork<T> coarse{};
  carve(host, in, adjoints, choice, take, &zeroed, &spill, coarse);
  return kBarrierBytes + take.used * sizeof(T);
}

template <class T>
cudaError_t run_forward(const HostPlan& host, const StepInputs<T>& in, const StepOutputs<T>& out, const Choice& choice,
                        void* workspace, cudaStream_t stream) {
  if (in.scenes == 0 || host.plan.num_vertices == 0) return cudaSuccess;
  if constexpr (!kOwnLaw) {
    if (choice.regime == kThread) {
      return run_scene_forward(host, in, out, choice, static_cast<uint8_t*>(workspace), stream);
    }
  }
  Runner<T> run(host, in, nullptr, choice, workspace, stream);
  run.contact.truncations = out.truncations;
  const int lanes = possible_lanes<T>(host, choice, choice.lanes, false);
  for (int64_t base = 0; base < in.scenes; base += choice.chunk) {
    run.choose(base, std::min(choice.chunk, in.scenes - base), out.tape);
    if (auto error = run.load(base, nullptr, nullptr, nullptr)) return error;
    if (auto error = run.sweep(forward_kernel<T>(in.energies, lanes), lanes, false)) return error;
    const int64_t items = run.s.scenes * run.s.positions;
    if (auto error = run.per_item(store_vertices<T>, items, in, run.s, base, out.x, out.v)) return error;
  }
  return cudaSuccess;
}

template <class T>
cudaError_t run_reverse(const HostPlan& host, const StepInputs<T>& in, const T* ends, const T* tape,
                        const StepAdjoints<T>& out, const Choice& choice, void* workspace, cudaStream_t stream) {
  if (in.scenes == 0 || host.plan.num_vertices == 0) return cudaSuccess;
  if constexpr (!kOwnLaw) {
    if (choice.regime == kThread) {
      return run_scene_reverse(host, in, ends, tape, out, choice, static_cast<uint8_t*>(workspace), stream);
    }
  }
  Runner<T> run(host, in, &out, choice, workspace, stream);
  run.s.limits = out.limits;
  const int lanes = possible_lanes<T>(host, choice, choice.lanes, true);
  for (int64_t base = 0; base < in.scenes; base += choice.chunk) {
    run.choose(base, std::min(choice.chunk, in.scenes - base), const_cast<T*>(tape));
    if (auto error = cudaMemsetAsync(run.first, 0, run.zeroed * sizeof(T), stream)) return error;
    if (auto error = run.load(base, ends, out.x_bar, out.v_bar)) return error;
    if (auto error = run.sweep(reverse_kernel_for<T>(in.energies, choice.wanted, lanes), lanes, true)) return error;
    if (auto error = run.store(base, out)) return error;
  }
  return cudaSuccess;
}

}  // namespace diffvbd::cuda
