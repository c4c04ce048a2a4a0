// Schemas of all operators, CPU and CUDA. The shapes are those of views.h and cpu/run.h; a leading size of 1 means that
// the scenes share a tensor, a last size of 1 in a material that all tets do.
#include <torch/csrc/stable/library.h>

#include <string>

#include "fields.h"

namespace {

// numbers: time_step, regularization, relaxation, saturation (< 0: none), saturation_eps, filter_eta, relaxation of the
// last sweep, motion within a step below which friction is smoothed
// sizes: active vertices, tets, slots of the plan; on CUDA also the rest of its header and color_block (plan_sizes in
// diffvbd/ops/fields.py)
// data_count: scalars per scene, or per vertex, of each energy of one vertex
// launch: on CUDA the regime of the sweeps, that of their reverse, the threads per vertex of both; else empty
// coarse: sizes of the plan of a coarse space, and 1 where the first sweep of the step comes before these; else empty
#define DIFFVBD_SETTINGS                                                                                  \
  "Tensor plan, int[] sizes, int energies, int[] data_count, float[] numbers, int sweeps, int[] launch, " \
  "int[] coarse, int tape_policy"

// Fields come first; what is returned ends without the comma of its last.
void define(torch::stable::detail::StableLibrary& m, const std::string& name, const std::string& fields,
            const std::string& others, const std::string& returns) {
  m.def((name + "(" + fields + others + ") -> (" + returns.substr(0, returns.size() - 2) + ")").c_str());
}

}  // namespace

STABLE_TORCH_LIBRARY(diffvbd, m) {
  // cut: [scenes, sweeps, vertices] exponents of limits (contact/limit.h), no scenes without contact. corrections
  // [scenes, corrections, 3 functions + bodies]: what coarse corrections have done; empty without them
  define(m, "sweep", DIFFVBD_ARGUMENTS(SWEEP), DIFFVBD_SETTINGS ", int debug_step, bool checked",
         "Tensor x, Tensor tape, Tensor cut, Tensor corrections, ");
  // x: the end of the sweeps; wants: material, mass, rest, energy_data
  define(m, "sweep_backward", DIFFVBD_ARGUMENTS(SWEEP),
         "Tensor x_bar, Tensor x, Tensor tape, Tensor corrections, Tensor cut, " DIFFVBD_SETTINGS ", bool[] wants",
         DIFFVBD_RETURNS(SWEEP));
  // CUDA only: predictor and velocity in the same launches, for scenes whose only energy is that of the tets.
  // prescribed: where pinned vertices go, or empty.
  define(m, "fused_step", DIFFVBD_ARGUMENTS(STEP), DIFFVBD_SETTINGS, "Tensor x, Tensor v, Tensor tape, ");
  // x_bar, v_bar: empty where there is none; wants: x, v, acceleration, prescribed, material, mass, rest
  define(m, "fused_step_backward", DIFFVBD_ARGUMENTS(STEP),
         "Tensor x_bar, Tensor v_bar, Tensor x_end, Tensor tape, " DIFFVBD_SETTINGS ", bool[] wants",
         DIFFVBD_RETURNS(STEP));
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
  // constants with the gaps of the pairs where the vertices are now, see contact/narrow.h
  m.def(
      "contact_narrow(Tensor x, Tensor origin, Tensor collider, Tensor room, Tensor pairs, Tensor constants, Tensor "
      "ptr) -> Tensor");
  // The pairs of a list that `keep` names, and which they are (contact/keep.h); exact: in lists as long as they are
  // many, on the CPU, else in room for all, with -1 where there is none
  m.def(
      "contact_keep(Tensor keep, Tensor pairs, Tensor constants, Tensor ptr, Tensor entry, bool exact) -> (Tensor "
      "rows, "
      "Tensor pairs, Tensor constants, Tensor ptr, Tensor entry)");
  // What a floor leaves of the ways of bodies as wholes, less u, and which it stops [scenes, bodies], see
  // contact/above_floor.h; u, planes and origin may be empty. The adjoint: of x, u, way and, of each body, the planes.
  m.def(
      "contact_above_floor(Tensor x, Tensor u, Tensor way, Tensor planes, Tensor origin, Tensor held, Tensor "
      "body_order, Tensor body_ptr) -> (Tensor left, Tensor stopped)");
  m.def(
      "contact_above_floor_backward(Tensor bar, Tensor x, Tensor u, Tensor way, Tensor planes, Tensor origin, "
      "Tensor held, Tensor body_order, Tensor body_ptr, bool wants_planes) -> (Tensor x, Tensor u, Tensor way, "
      "Tensor planes)");
  // What is decided at the start of a part, see contact/part.h; planes, origin and own_room may be empty. state uint8
  // [scenes, vertices]: 0 goes, 1 rests, 2 rests unless its body's potential does not rise
  m.def(
      "contact_frames(Tensor x, Tensor move, Tensor u, Tensor way, Tensor left, Tensor stretch, Tensor room, "
      "Tensor own_room, Tensor held, Tensor held_bodies, Tensor body, Tensor body_order, Tensor body_ptr) -> "
      "(Tensor limit, Tensor ways, Tensor center, Tensor room, Tensor own_room)");
  m.def(
      "contact_bends(Tensor x, Tensor move, Tensor u, Tensor left, Tensor frames, Tensor limit, Tensor stopped, "
      "Tensor own_room, Tensor planes, Tensor origin, Tensor held, Tensor held_bodies, Tensor body, Tensor "
      "body_order, Tensor body_ptr, float filter_eta) -> (Tensor base, Tensor target, Tensor way, Tensor state)");
  m.def("contact_hold(Tensor way, Tensor state, Tensor rises) -> (Tensor way, Tensor state)");
  m.def(
      "contact_held_up(Tensor base, Tensor way, Tensor share, Tensor state, Tensor held, Tensor held_bodies, "
      "Tensor body, Tensor body_order, Tensor body_ptr) -> (Tensor to, Tensor state)");
  m.def(
      "contact_falls(Tensor x, Tensor move, Tensor fall, Tensor u, Tensor left, Tensor frames, Tensor share, "
      "Tensor state, Tensor planes, Tensor origin, Tensor held, Tensor held_bodies, Tensor body, Tensor "
      "body_order, Tensor body_ptr, float filter_eta) -> (Tensor share, Tensor at, Tensor way)");
  // Where each vertex starts, and whether pairs have held up more than a hundredth of its way, see contact/start.h. The
  // adjoint: of x, move, fall, u, left and planes, all for each vertex.
  m.def(
      "contact_start(Tensor x, Tensor move, Tensor fall, Tensor u, Tensor left, Tensor frames, Tensor share, "
      "Tensor last_share, Tensor stopped, Tensor planes, Tensor origin, Tensor held, Tensor held_bodies, Tensor "
      "body, Tensor body_order, Tensor body_ptr, float filter_eta) -> (Tensor x, Tensor short)");
  m.def(
      "contact_start_backward(Tensor bar, Tensor x, Tensor move, Tensor fall, Tensor u, Tensor left, Tensor "
      "frames, Tensor share, Tensor last_share, Tensor planes, Tensor origin, Tensor held, Tensor held_bodies, "
      "Tensor body, Tensor body_order, Tensor body_ptr, float filter_eta, bool wants_planes) -> (Tensor x, "
      "Tensor move, Tensor fall, Tensor u, Tensor left, Tensor planes)");
  // Normal force, 1 where active, normal and weights of each pair [pairs, 9], and the adjoint of where corner points
  // are [B, N, 3] and of kappa
  m.def(
      "contact_lag(Tensor x, Tensor origin, Tensor collider, Tensor kappa, Tensor pairs, Tensor constants, Tensor ptr, "
      "Tensor entry) -> Tensor");
  m.def(
      "contact_lag_backward(Tensor bar, Tensor x, Tensor origin, Tensor collider, Tensor kappa, Tensor pairs, Tensor "
      "constants, Tensor ptr, Tensor entry) -> (Tensor points, Tensor kappa)");
  // Friction, damping, normal and weights of each pair [pairs, 9], by the coefficients of its scene, which may be
  // empty, and the forces of pairs on corner points [B, N, 3]; the adjoint, of which either bar may be empty
  m.def(
      "contact_rubbing(Tensor x, Tensor origin, Tensor collider, Tensor kappa, Tensor friction, Tensor damping, Tensor "
      "pairs, Tensor constants, Tensor ptr, Tensor entry) -> (Tensor lag, Tensor push)");
  m.def(
      "contact_rubbing_backward(Tensor lag_bar, Tensor push_bar, Tensor x, Tensor origin, Tensor collider, Tensor "
      "kappa, Tensor friction, Tensor damping, Tensor pairs, Tensor constants, Tensor ptr, Tensor entry) -> (Tensor "
      "points, Tensor kappa, Tensor friction, Tensor damping)");
  // What is left of lift once forces have borne their part of each body's acceleration, see contact/unsupported.h;
  // origin and planes may be empty. The adjoint: of x, empty without planes, lift, force and mass, and of planes by
  // body [scenes, bodies, 7 planes] where wanted.
  m.def(
      "contact_unsupported(Tensor x, Tensor origin, Tensor lift, Tensor force, Tensor mass, Tensor planes, Tensor "
      "held_bodies, Tensor body_order, Tensor body_ptr, float time_step) -> Tensor");
  m.def(
      "contact_unsupported_backward(Tensor bar, Tensor x, Tensor origin, Tensor lift, Tensor force, Tensor mass, "
      "Tensor planes, Tensor held_bodies, Tensor body_order, Tensor body_ptr, float time_step, bool wants_planes) -> "
      "(Tensor x, Tensor lift, Tensor force, Tensor mass, Tensor planes)");
  // How far sweeps may carry each vertex [scenes, vertices], see contact/sweep_rooms.h; own_center and own_room may be
  // empty. more: factor of what sweeps take back; least: what they are given beside that [m]
  m.def(
      "contact_sweep_rooms(Tensor x, Tensor start, Tensor begin, Tensor move, Tensor fall, Tensor apart, Tensor "
      "stretched, Tensor center, Tensor room, Tensor own_center, Tensor own_room, Tensor held, Tensor body_order, "
      "Tensor body_ptr, float more, float least) -> Tensor");
  // The rigid correction of each body that is listed, and the velocity (x - x_prev) / h. groups: how many bodies a
  // thread, a part of a warp, a block and the whole device work on (CUDA)
  define(m, "rigid", DIFFVBD_ARGUMENTS(RIGID), "int[] groups, int[] data_count, float time_step",
         "Tensor x, Tensor v, ");
  // v_bar: empty where there is none. Adjoints of x, x_prev (empty without energies and v_bar), y, mass, and of data:
  // [scenes, bodies, scalars of a scene] and [scenes, vertices, scalars of a vertex]
  define(m, "rigid_backward", DIFFVBD_ARGUMENTS(RIGID),
         "Tensor x_bar, Tensor v_bar, int[] groups, int[] data_count, float time_step, bool wants_data",
         "Tensor x, Tensor x_prev, Tensor y, Tensor mass, Tensor shared, Tensor own, ");
  // The Newton step of the rigid motions of all bodies of a scene, float64: centers of mass [scenes, bodies, 3], motion
  // [scenes, bodies, 6], the factors of groups that touch, in the memory [scenes, bodies, 6, 6 most] that
  // contact/groups.h says, and groups [scenes, 4, bodies]; of few bodies one factor [scenes, 6 bodies, 6 bodies], and
  // no groups. moving [scenes, bodies]: only groups of these bodies move; or [0]: all do. alone: of many bodies only
  // groups of one do, with factors [scenes, bodies, 6, 6]
  define(m, "contact_rigid_system", DIFFVBD_ARGUMENTS(TOUCHING),
         "int[] data_count, float time_step, float friction_eps, Tensor moving, bool alone",
         "Tensor centers, Tensor motion, Tensor factor, Tensor groups, ");
  // The state after each body has taken what it may of its motion [scenes, bodies, 6]; that share [scenes, bodies],
  // zero of what does not move beside a mask `moving`; whether it has a motion; whether it was held up where others
  // that were have gone on; and how much of its shift is left [m]
  define(m, "contact_rigid_move", DIFFVBD_ARGUMENTS(TOUCHING),
         "Tensor centers, Tensor motion, int[] data_count, float time_step, float friction_eps, Tensor moving",
         "Tensor x, Tensor share, Tensor moved, Tensor held, Tensor left, ");
  // Of the virtual work of two motions p and q of all corner points [scenes, N, 3] that pairs do: its derivatives by
  // where these points are, by p and by q [scenes, N, 3] each; since [scenes, N, 3]: the first of lagged pairs alone,
  // or empty; by kappa for each listed pair; and less those by what is lagged [lagged, 9]. This part of
  // contact_rigid_reverse can so be tested by itself
  define(m, "contact_rigid_backward", DIFFVBD_ARGUMENTS(TOUCHING),
         "Tensor p, Tensor q, Tensor groups, int[] data_count, float time_step, float friction_eps",
         "Tensor by_x, Tensor by_p, Tensor by_q, Tensor since, Tensor by_kappa, Tensor lag_bar, ");
  // The adjoint of corrections one after another, each from `at` [scenes, V, 3], by its motion, share, factor and
  // groups, of that of where the last one led, x_bar [scenes, V, 3]: of the first `at`, x_prev, y and mass, of data as
  // of rigid_backward(), of floor_lag, of colliders at the end and at the start of the step, minus what each listed
  // pair adds to that of kappa, and of lag
  define(m, "contact_rigid_reverse", DIFFVBD_ARGUMENTS(TOUCHING),
         "Tensor[] at, Tensor[] motion, Tensor[] share, Tensor[] factor, Tensor[] groups, Tensor x_bar, int[] "
         "data_count, float time_step, float friction_eps, bool wants_data",
         "Tensor x, Tensor x_prev, Tensor y, Tensor mass, Tensor shared, Tensor own, Tensor floor_lag, Tensor "
         "collider, Tensor collider_prev, Tensor by_kappa, Tensor lag_bar, ");
  // Predictor and start of the sweeps. chord: as in rigid/coast.h. start: of the bodies that are not corrected, 0 x + h
  // v, 1 y, 2 the lower potential of the two; falls [scenes, other bodies]: 1 where that is y; alone [scenes, bodies]:
  // with parts, 1 where the vertices of a body that is corrected start each by itself
  define(m, "begin", DIFFVBD_ARGUMENTS(BEGIN),
         "int[] groups, int[] other_groups, int[] data_count, float time_step, float filter_eta, float chord, "
         "int start, bool filters, bool parts",
         "Tensor x_start, Tensor y, Tensor falls, Tensor alone, ");
  // wants: acceleration, prescribed, energy_data. Of data: from corrections as of rigid_backward(), and of the planes
  // by vertex [scenes, vertices, scalars of the planes]
  define(m, "begin_backward", DIFFVBD_ARGUMENTS(BEGIN),
         "Tensor x_start_bar, Tensor y_bar, Tensor falls, Tensor alone, int[] groups, int[] data_count, float "
         "time_step, float filter_eta, float chord, int start, bool filters, bool[] wants",
         "Tensor x, Tensor v, Tensor acceleration, Tensor prescribed, Tensor mass, Tensor shared, Tensor own, Tensor "
         "planes, ");
  // The matrices of all bodies, one after the other, or if factored their Cholesky factors (CUDA: inverses); adjoints
  // of x_prev, stiffness and mass from that of the matrices
  define(m, "coarse_matrix", DIFFVBD_ARGUMENTS(COARSE), "int[] sizes, float time_step, bool factored",
         "Tensor factor, ");
  define(m, "coarse_matrix_backward", DIFFVBD_ARGUMENTS(COARSE), "Tensor bar, int[] sizes, float time_step",
         DIFFVBD_RETURNS(COARSE));
  // Of what these are made, see coarse/sums.h; adjoints of the moduli [scenes, tets], and, where wanted, of the rest
  // shape.
  m.def(
      "coarse_stiffness(Tensor mu, Tensor lam, Tensor gradients, Tensor volume, Tensor plan, Tensor weights, int[] "
      "sizes) -> Tensor");
  m.def(
      "coarse_stiffness_backward(Tensor mu, Tensor lam, Tensor gradients, Tensor volume, Tensor plan, Tensor weights, "
      "Tensor bar, int[] sizes, bool wants_rest) -> (Tensor mu, Tensor lam, Tensor gradients, Tensor volume)");
  m.def("coarse_mass(Tensor mass, Tensor plan, Tensor weights, int[] sizes) -> Tensor");
  m.def("coarse_mass_backward(Tensor bar, Tensor plan, Tensor weights, int[] sizes) -> Tensor");
  // By how much the potential of each body rises from x to `to`, and the sum of the sizes of its terms
  // [scenes, bodies, 2], float64; infinite where a vertex comes too near a plane. order, ptr: vertices that move, by
  // body; material [1 | scenes, blocks, 2, lanes], rest [1 | scenes, blocks, 7, lanes] and corner (four times a vertex)
  // of the tets, by body
  m.def(
      "potential_rise(Tensor x, Tensor to, Tensor x_prev, Tensor y, Tensor mass, Tensor energy_data, Tensor origin, "
      "Tensor material, Tensor rest, Tensor order, Tensor ptr, Tensor other, Tensor corner, Tensor block_ptr, int[] "
      "data_count, float time_step) -> Tensor");
  m.def("pack_rest(Tensor rest, Tensor plan, int[] sizes) -> Tensor");
  m.def(
      "build_plan(Tensor points, Tensor tets, Tensor active, int lanes) -> (Tensor plan, Tensor color_ptr, Tensor "
      "color_vertices, Tensor star_ptr, Tensor star)");
  m.def("tet_gather(Tensor values, Tensor tets) -> Tensor");
  m.def("star_sum(Tensor values, Tensor star_ptr, Tensor star, bool positive) -> Tensor");
  m.def("row_sum(Tensor values) -> Tensor");
  // results as in contact/candidates.h; mesh_bodies: body labels from there on are colliders; room [scenes, mesh_bodies
  // + 1]: how far the vertices of a body may go before the next detection, and the largest; trim (CPU): the list has as
  // many rows as there are pairs, and no more than the capacity
  m.def(
      "contact_detect(Tensor x, Tensor origin, Tensor collider, Tensor collider_next, Tensor rest, Tensor radius, "
      "Tensor triangles, Tensor edges, Tensor points, Tensor planes, Tensor body, Tensor held, Tensor room, "
      "Tensor own_room, int mesh_bodies, bool self_contact, bool between_bodies, float dhat, int capacity, bool trim) "
      "-> (Tensor pairs, "
      "Tensor constants, Tensor ptr, Tensor entry, Tensor near_corners, Tensor near_values, Tensor counts, "
      "Tensor smallest)");
  // results as in contact/intersect.h
  m.def(
      "contact_intersections(Tensor x, Tensor origin, Tensor collider, Tensor rest, Tensor radius, Tensor triangles, "
      "Tensor edges, Tensor points, Tensor planes, Tensor body, Tensor held, int mesh_bodies, bool self_contact, bool "
      "between_bodies, int capacity) -> (Tensor pairs, Tensor counts, Tensor first)");
  m.def(
      "contact_islands(Tensor x, Tensor origin, Tensor move, Tensor mass, Tensor collider, Tensor collider_next, "
      "Tensor planes, Tensor body, Tensor body_order, Tensor body_ptr, Tensor held, Tensor radius, Tensor room, int "
      "mesh_bodies, float dhat, bool any_direction) -> Tensor");
  // What of the ways that vertices want to go is a rigid motion of each body [B, V, 3]; the longest ways [5, B, bodies]
  // and the sums [B, bodies, 4] of contact/motion.h. origin and fall may be empty
  m.def(
      "contact_motion(Tensor x, Tensor origin, Tensor mass, Tensor move, Tensor fall, Tensor held, Tensor held_bodies, "
      "Tensor order, Tensor ptr) -> (Tensor rigid, Tensor ways, Tensor sums)");
  m.def(
      "contact_motion_backward(Tensor bar, Tensor x, Tensor origin, Tensor mass, Tensor move, Tensor held, Tensor "
      "held_bodies, Tensor order, Tensor ptr) -> (Tensor x, Tensor move, Tensor mass)");
  // The ways of `move`, of free bodies without what stretches them, see contact/coast.h
  m.def(
      "contact_coast(Tensor x, Tensor mass, Tensor move, Tensor held, Tensor held_bodies, Tensor order, Tensor ptr, "
      "float chord) -> Tensor");
  m.def(
      "contact_coast_backward(Tensor bar, Tensor x, Tensor mass, Tensor move, Tensor held, Tensor held_bodies, Tensor "
      "order, Tensor ptr, float chord) -> (Tensor x, Tensor mass, Tensor move)");
  // How far bodies may go until pairs are found again, see contact/rooms.h: their islands [B, bodies] int32, rooms and
  // rooms of their own [B, bodies + 1], and how far they want to go over the most room [B, bodies]
  m.def(
      "contact_rooms(Tensor x, Tensor origin, Tensor mass, Tensor move, Tensor held, Tensor order, Tensor ptr, Tensor "
      "rigid, Tensor ways, Tensor sums, Tensor floor, Tensor collider, Tensor collider_next, Tensor planes, Tensor "
      "body, Tensor radius, Tensor most, Tensor most_alone, Tensor most_own, Tensor least_own, float dhat, float "
      "share, float least, bool any_direction, bool self_contact) -> (Tensor island, Tensor room, Tensor own_room, "
      "Tensor over)");
  // How much of its way each vertex goes at the start, see contact/advance.h: [scenes, vertices], or all of a body
  // [scenes, bodies] where it goes as a whole; stuck: how many pairs what is prescribed brings too close. center: what
  // a vertex may leave by its room at most, and own_center by its own_room, unless empty
  m.def(
      "contact_advance(Tensor x, Tensor move, Tensor u, Tensor center, Tensor origin, Tensor collider, Tensor "
      "collider_next, Tensor held, Tensor body, Tensor room, Tensor own_center, Tensor own_room, Tensor pairs, Tensor "
      "constants, Tensor ptr, Tensor entry, bool careful, bool whole) -> (Tensor share, Tensor stuck)");
  m.def("segment_sum(Tensor values, Tensor order, Tensor ptr) -> Tensor");
  // points [B, N, 3]; pairs [max_pairs, 3] int32: (scene, i, j), then rows of -1; count [1] int64: how many there are,
  // or -1 where a point is not finite
  m.def("neighbor_pairs(Tensor points, float radius, int max_pairs) -> (Tensor pairs, Tensor count)");
}
