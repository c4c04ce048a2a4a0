// Lists of what the operators of a step read: their parameters and the structs that carry them follow from these, and
// so do the NamedTuples in diffvbd/ops/fields.py. ADJOINT: what is differentiated, in the order of what a backward
// returns.
#pragma once

#include <tuple>
#include <utility>

#include "operator.h"

// clang-format off
// The predictor and the start; the body; data of the energies; contact, all empty without it: colliders, stiffness,
// the pairs that repel, what friction and damping keep of the start of the step, and from where and how far a vertex may
// go (contact/limit.h); last the corrections on a coarse space (coarse/views.h), if any. The adjoint of a factor stands for that of the matrix that it is of.
#define DIFFVBD_SWEEP_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x_start) ADJOINT(x_prev) ADJOINT(y) \
  ADJOINT(mu) ADJOINT(lam) ADJOINT(mass) ADJOINT(rest) \
  ADJOINT(energy_data) INDEX(origin) \
  ADJOINT(collider) ADJOINT(collider_prev) ADJOINT(kappa) \
  INDEX(pairs) INDEX(constants) INDEX(ptr) INDEX(entry) \
  ADJOINT(lag) INDEX(lag_pairs) INDEX(lag_ptr) INDEX(lag_entry) ADJOINT(floor_lag) INDEX(center) INDEX(trust_radius) \
  ADJOINT(coarse_factor) INDEX(coarse_mass) INDEX(coarse_plan) INDEX(coarse_weights) INDEX(coarse_rest)

// The matrix of a coarse space at the start of a step (coarse/matrix.h): plan int32, moments [n, 3] and volume [groups]
// of the groups, stiffness [1 | scenes, groups, 3, 3, width, width], mass [1 | scenes, cells].
#define DIFFVBD_COARSE_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x_prev) ADJOINT(stiffness) ADJOINT(mass) INDEX(plan) INDEX(moments) INDEX(volume)

// A whole step in one operator (CUDA).
#define DIFFVBD_STEP_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x) ADJOINT(v) ADJOINT(acceleration) ADJOINT(prescribed) \
  ADJOINT(mu) ADJOINT(lam) ADJOINT(mass) ADJOINT(rest)

// The rigid correction (rigid/body.h): order, ptr: vertices of the bodies that are corrected; spread: their squared
// radius of gyration [m^2]; other [vertices]: -2 for what is listed.
#define DIFFVBD_RIGID_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x) ADJOINT(x_prev) ADJOINT(y) ADJOINT(mass) ADJOINT(energy_data) INDEX(origin) \
  INDEX(order) INDEX(ptr) INDEX(spread) INDEX(other)

// The rigid correction of bodies that touch (subspace/rigid_step.h): vertices by body; free [bodies] bool: nothing of it
// is pinned; pinned and body of all corner points; contact as of the sweeps.
#define DIFFVBD_TOUCHING_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x) ADJOINT(x_prev) ADJOINT(y) ADJOINT(mass) ADJOINT(energy_data) INDEX(origin) \
  INDEX(order) INDEX(ptr) INDEX(free) INDEX(pinned) INDEX(body) \
  ADJOINT(collider) ADJOINT(collider_prev) ADJOINT(kappa) \
  INDEX(pairs) INDEX(constants) INDEX(pair_ptr) INDEX(pair_entry) \
  ADJOINT(lag) INDEX(lag_pairs) INDEX(lag_ptr) INDEX(lag_entry) ADJOINT(floor_lag) INDEX(center) INDEX(trust_radius)

// The coarse functions of a Model, by vertex and by function, int32, but weight; the star of each vertex; and the tets'
// material and rest shape (subspace/contact_coarse.h).
#define DIFFVBD_SPACE_FIELDS(ADJOINT, INDEX) \
  INDEX(vertex_ptr) INDEX(function) INDEX(weight) INDEX(function_ptr) INDEX(entry) INDEX(vertex) INDEX(own) \
  INDEX(body_ptr) INDEX(body_function) INDEX(tets) INDEX(star_ptr) INDEX(star) ADJOINT(mu) ADJOINT(lam) ADJOINT(rest)

// The beginning of a step (start/begin.h): as of the correction, and the other bodies. other [vertices]: which of them
// a vertex is in, -1: none, -2: it is corrected; tets, other_tets [listed, 5]: a tet and its corners; rest [1 | scenes,
// tets, kRestScalars], empty where tets have no energy.
#define DIFFVBD_BEGIN_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x) ADJOINT(v) ADJOINT(acceleration) ADJOINT(prescribed) ADJOINT(mass) ADJOINT(energy_data) INDEX(origin) \
  INDEX(mu) INDEX(lam) INDEX(rest) INDEX(pinned) \
  INDEX(order) INDEX(ptr) INDEX(spread) INDEX(tets) INDEX(tet_ptr) INDEX(other) \
  INDEX(other_order) INDEX(other_ptr) INDEX(other_tets) INDEX(other_tet_ptr)
// clang-format on

// The parameters of an operator, each with a comma; and a struct of them.
#define DIFFVBD_PARAMETER(name) In name,
#define DIFFVBD_ITEM(name) name,
#define DIFFVBD_NONE(name)
#define DIFFVBD_PARAMETERS(LIST) DIFFVBD_##LIST##_FIELDS(DIFFVBD_PARAMETER, DIFFVBD_PARAMETER)
#define DIFFVBD_ITEMS(LIST) DIFFVBD_##LIST##_FIELDS(DIFFVBD_ITEM, DIFFVBD_ITEM)

namespace diffvbd {

#define DIFFVBD_TENSOR(name) Tensor name;
#define DIFFVBD_TUPLE(name) std::make_tuple(name),

// A list by the names of its fields, and the adjoints of one: empty where not wanted.
#define DIFFVBD_STRUCT(Name, LIST)                          \
  struct Name {                                             \
    DIFFVBD_##LIST##_FIELDS(DIFFVBD_TENSOR, DIFFVBD_TENSOR) \
  };
#define DIFFVBD_BARS(Name, LIST)                                                                  \
  struct Name {                                                                                   \
    DIFFVBD_##LIST##_FIELDS(DIFFVBD_TENSOR, DIFFVBD_NONE) auto tensors() const {                  \
      return std::tuple_cat(DIFFVBD_##LIST##_FIELDS(DIFFVBD_TUPLE, DIFFVBD_NONE) std::tuple<>{}); \
    }                                                                                             \
  };
DIFFVBD_STRUCT(SweepFields, SWEEP)
DIFFVBD_STRUCT(StepFields, STEP)
DIFFVBD_STRUCT(RigidFields, RIGID)
DIFFVBD_STRUCT(TouchingFields, TOUCHING)
DIFFVBD_STRUCT(SpaceFields, SPACE)
DIFFVBD_STRUCT(BeginFields, BEGIN)
DIFFVBD_STRUCT(CoarseFields, COARSE)
DIFFVBD_BARS(SweepBars, SWEEP)
DIFFVBD_BARS(StepBars, STEP)

#undef DIFFVBD_TENSOR
#undef DIFFVBD_TUPLE
#undef DIFFVBD_STRUCT
#undef DIFFVBD_BARS

}  // namespace diffvbd
