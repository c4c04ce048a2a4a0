// Schemas of all operators, CPU and CUDA. The shapes are those of views.h and cpu/run.h; a leading size of 1 means that
// the scenes share a tensor, a last size of 1 in mu and lam that all tets do.
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(diffvbd, m) {
  // numbers: time_step, regularization, relaxation, saturation (< 0: none), saturation_eps, filter_eta,
  // relaxation of the last sweep
  // sizes: active vertices, tets, slots of the plan; on CUDA also the rest of its header and color_block (plan_sizes in
  // diffvbd/ops/fields.py)
  // data_count: scalars per scene, or per vertex, of each energy of one vertex
  // launch: on CUDA the regime and the threads per vertex of the sweeps and of their reverse, else empty
  m.def(
      "sweep(Tensor x_start, Tensor x_prev, Tensor y, Tensor mu, Tensor lam, Tensor mass, Tensor rest, "
      "Tensor energy_data, Tensor origin, Tensor plan, int[] sizes, int energies, int[] data_count, float[] numbers, "
      "int sweeps, int[] launch, int tape_policy, int debug_step, bool checked) -> (Tensor x, Tensor tape)");
  // wants: material, mass, rest, energy_data
  m.def(
      "sweep_backward(Tensor x_bar, Tensor x, Tensor x_prev, Tensor y, Tensor mu, Tensor lam, Tensor mass, Tensor "
      "rest, Tensor energy_data, Tensor origin, Tensor tape, Tensor plan, int[] sizes, int energies, int[] data_count, "
      "float[] numbers, int sweeps, int[] launch, int tape_policy, bool[] wants) -> (Tensor x_start, Tensor x_prev, "
      "Tensor y, Tensor mu, Tensor lam, Tensor mass, Tensor rest, Tensor energy_data)");
  // CUDA only: predictor and velocity in the same launches, for scenes whose only energy is that of the tets. `held` is
  // where pinned vertices go, or empty.
  m.def(
      "fused_step(Tensor x, Tensor v, Tensor acceleration, Tensor held, Tensor mu, Tensor lam, Tensor mass, Tensor "
      "rest, Tensor plan, int[] sizes, int energies, int[] data_count, float[] numbers, int sweeps, int[] launch, int "
      "tape_policy) -> (Tensor x, Tensor v, Tensor tape)");
  // x_bar, v_bar: empty where there is none; wants: x, v, acceleration, held, material, mass, rest
  m.def(
      "fused_step_backward(Tensor x_bar, Tensor v_bar, Tensor x_end, Tensor x, Tensor v, Tensor acceleration, Tensor "
      "held, Tensor mu, Tensor lam, Tensor mass, Tensor rest, Tensor tape, Tensor plan, int[] sizes, int energies, "
      "int[] data_count, float[] numbers, int sweeps, int[] launch, int tape_policy, bool[] wants) -> (Tensor x, "
      "Tensor v, Tensor acceleration, Tensor held, Tensor mu, Tensor lam, Tensor mass, Tensor rest)");
  // The same with contact, of pairs made by contact_detect: see bind/contact.h and contact/passes.h for the
  // shapes. cut [scenes, vertices]: 1 where a bound has held back an update.
  m.def(
      "contact_sweep(Tensor x_start, Tensor x_prev, Tensor y, Tensor mu, Tensor lam, Tensor mass, Tensor rest, "
      "Tensor energy_data, Tensor origin, Tensor bounds, Tensor collider, Tensor collider_prev, Tensor kappa, Tensor "
      "pairs, Tensor constants, Tensor ptr, Tensor entry, Tensor lag, Tensor lag_pairs, Tensor lag_ptr, Tensor "
      "lag_entry, Tensor floor_lag, float friction_eps, Tensor plan, int[] sizes, int energies, int[] data_count, "
      "float[] numbers, int sweeps, int[] launch, int tape_policy, int debug_step, bool checked) -> (Tensor x, Tensor "
      "tape, Tensor cut)");
  m.def(
      "contact_sweep_backward(Tensor x_bar, Tensor x, Tensor x_prev, Tensor y, Tensor mu, Tensor lam, Tensor mass, "
      "Tensor rest, Tensor energy_data, Tensor origin, Tensor bounds, Tensor collider, Tensor collider_prev, Tensor "
      "kappa, Tensor pairs, Tensor constants, Tensor ptr, Tensor entry, Tensor lag, Tensor lag_pairs, Tensor lag_ptr, "
      "Tensor lag_entry, Tensor floor_lag, float friction_eps, Tensor tape, Tensor plan, int[] sizes, int energies, "
      "int[] data_count, float[] numbers, int sweeps, int[] launch, int tape_policy, bool[] wants) -> (Tensor x_start, "
      "Tensor x_prev, Tensor y, Tensor mu, Tensor lam, Tensor mass, Tensor rest, Tensor energy_data, Tensor bounds, "
      "Tensor collider, Tensor collider_prev, Tensor kappa, Tensor lag, Tensor floor_lag)");
  // The lowest vertex above each plane of a floor, of the island that a body is in; planes as in the data of
  // FloorBarrier
  m.def(
      "contact_lowest(Tensor x, Tensor origin, Tensor planes, Tensor body_order, Tensor body_ptr, Tensor island) -> "
      "Tensor");
  // Translation of each body's island [scenes, bodies, 3], see contact/translation.h; without a floor planes and lowest
  // are empty. The adjoint: of move, mass, x and planes.
  m.def(
      "contact_translation(Tensor move, Tensor mass, Tensor x, Tensor origin, Tensor planes, Tensor held, Tensor body, "
      "Tensor body_order, Tensor body_ptr, Tensor island, Tensor lowest) -> Tensor");
  m.def(
      "contact_translation_backward(Tensor u_bar, Tensor move, Tensor mass, Tensor x, Tensor origin, Tensor planes, "
      "Tensor held, Tensor body, Tensor body_order, Tensor body_ptr, Tensor island, Tensor lowest) -> (Tensor move, "
      "Tensor mass, Tensor x, Tensor planes)");
  // Bounds, start, what is left to go, and 1 where a bound has cut, see contact/start.h. The adjoint: of x, move, goal,
  // u (for each vertex), the gap of near, and planes (for each vertex).
  m.def(
      "contact_start(Tensor x, Tensor move, Tensor goal, Tensor u, Tensor near, Tensor origin, Tensor planes, Tensor "
      "held, Tensor body, float gamma, float cap, float filter_eta) -> (Tensor bounds, Tensor start, Tensor move, "
      "Tensor outside)");
  m.def(
      "contact_start_backward(Tensor bounds_bar, Tensor start_bar, Tensor move_bar, Tensor x, Tensor move, Tensor "
      "goal, "
      "Tensor u, Tensor near, Tensor origin, Tensor planes, Tensor held, Tensor body, float gamma, float cap, float "
      "filter_eta, bool wants_planes) -> (Tensor x, Tensor move, Tensor goal, Tensor u, Tensor gap, Tensor planes)");
  // Normal force, 1 where active, normal and weights of each pair [pairs, 9], and the adjoint of x, collider and kappa
  m.def(
      "contact_lag(Tensor x, Tensor origin, Tensor collider, Tensor kappa, Tensor pairs, Tensor constants, Tensor ptr, "
      "Tensor "
      "entry) -> Tensor");
  m.def(
      "contact_lag_backward(Tensor bar, Tensor x, Tensor origin, Tensor collider, Tensor kappa, Tensor pairs, Tensor "
      "constants, Tensor ptr, Tensor entry) -> (Tensor x, Tensor collider, Tensor kappa)");
  // The rigid correction of each body that is listed, see rigid/body.h, and the velocity (x - x_prev) / h; order, ptr:
  // their vertices; spread: squared radius of gyration [m^2]; other [vertices]: -2 for what is listed; groups: how many
  // bodies a thread, a part of a warp, a block and the whole device work on (CUDA)
  m.def(
      "rigid(Tensor x, Tensor x_prev, Tensor y, Tensor mass, Tensor energy_data, Tensor origin, Tensor order, Tensor "
      "ptr, Tensor spread, Tensor other, int[] groups, int[] data_count, float time_step) -> (Tensor x, Tensor v)");
  // v_bar: empty where there is none. Adjoints of x, x_prev (empty without energies and v_bar), y, mass, and of data:
  // [scenes, bodies, scalars of a scene] and [scenes, vertices, scalars of a vertex]
  m.def(
      "rigid_backward(Tensor x_bar, Tensor v_bar, Tensor x, Tensor x_prev, Tensor y, Tensor mass, Tensor energy_data, "
      "Tensor origin, "
      "Tensor order, Tensor ptr, Tensor spread, Tensor other, int[] groups, int[] data_count, float time_step, bool "
      "wants_data) -> "
      "(Tensor x, Tensor x_prev, Tensor y, Tensor mass, Tensor shared, Tensor own)");
  // Predictor and start of the sweeps, see start/begin.h. x, v, held: held is where pinned vertices go, or empty;
  // order ... groups: the bodies that are corrected, as of rigid(); other [vertices]: which of the other bodies a
  // vertex is in, -1: none, -2: it is corrected; other_tets [listed, 5]: a tet and its corners; start: of the other
  // bodies, 0 x + h v, 1 y, 2 the lower potential of the two, for which mu, lam and rest [1 | scenes, tets, 7] are
  // (rest is empty where tets have no energy); falls [scenes, other bodies]: 1 where that is y
  m.def(
      "begin(Tensor x, Tensor v, Tensor acceleration, Tensor held, Tensor mass, Tensor energy_data, Tensor origin, "
      "Tensor mu, Tensor lam, Tensor rest, Tensor pinned, Tensor order, Tensor ptr, Tensor spread, int[] groups, "
      "Tensor other, Tensor other_order, Tensor other_ptr, Tensor other_tets, Tensor other_tet_ptr, int[] "
      "other_groups, int[] data_count, float time_step, float filter_eta, int start, bool filters) -> (Tensor x_start, "
      "Tensor y, Tensor falls)");
  // wants: acceleration, held, energy_data. Of data: from corrections as of rigid_backward(), and of the planes by
  // vertex [scenes, vertices, scalars of the planes]
  m.def(
      "begin_backward(Tensor x_start_bar, Tensor y_bar, Tensor falls, Tensor x, Tensor v, Tensor acceleration, Tensor "
      "held, Tensor mass, Tensor energy_data, Tensor origin, Tensor pinned, Tensor order, Tensor ptr, Tensor spread, "
      "int[] groups, Tensor other, int others, int[] data_count, float time_step, float filter_eta, int start, bool "
      "filters, bool[] wants) -> (Tensor x, Tensor v, Tensor acceleration, Tensor held, Tensor mass, Tensor shared, "
      "Tensor own, Tensor planes)");
  m.def("pack_rest(Tensor rest, Tensor plan, int[] sizes) -> Tensor");
  m.def(
      "build_plan(Tensor points, Tensor tets, Tensor active, int lanes) -> (Tensor plan, Tensor color_ptr, Tensor "
      "color_vertices, Tensor star_ptr, Tensor star)");
  m.def("tet_gather(Tensor values, Tensor tets) -> Tensor");
  m.def("star_sum(Tensor values, Tensor star_ptr, Tensor star, bool positive) -> Tensor");
  m.def("row_sum(Tensor values) -> Tensor");
  // results as in contact/candidates.h; mesh_bodies: body labels from there on are colliders
  m.def(
      "contact_detect(Tensor x, Tensor origin, Tensor collider, Tensor collider_next, Tensor rest, Tensor radius, "
      "Tensor triangles, Tensor edges, Tensor points, Tensor planes, Tensor body, Tensor held, int mesh_bodies, bool "
      "self_contact, bool between_bodies, float dhat, float reach, float cap, float gamma, int capacity) -> (Tensor "
      "pairs, Tensor constants, Tensor ptr, Tensor entry, Tensor near_corners, Tensor near_values, Tensor counts, "
      "Tensor smallest)");
  m.def(
      "contact_islands(Tensor x, Tensor origin, Tensor move, Tensor mass, Tensor collider, Tensor collider_next, "
      "Tensor planes, Tensor body, Tensor body_order, Tensor body_ptr, Tensor held, Tensor radius, int mesh_bodies, "
      "float cap, float dhat, bool any_direction) -> Tensor");
  m.def("segment_sum(Tensor values, Tensor order, Tensor ptr) -> Tensor");
  // points [B, N, 3]; pairs [max_pairs, 3] int32: (scene, i, j), then rows of -1; count [1] int64: how many there are,
  // or -1 where a point is not finite
  m.def("neighbor_pairs(Tensor points, float radius, int max_pairs) -> (Tensor pairs, Tensor count)");
}
