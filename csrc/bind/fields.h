// THE lists of what the operators of a step read. Schemas pass each as one list of tensors in this order; twins are the
// NamedTuples in diffvbd/ops/fields.py. ADJOINT: what is differentiated, in the order of what a backward returns.
#pragma once

#include <torch/csrc/stable/tensor.h>

#include <stdexcept>
#include <vector>

// The predictor and the start; the body; data of the energies; contact, all empty without it: bounds, colliders,
// stiffness, the pairs that repel, and what friction and damping keep of the start of the step.
#define DIFFVBD_SWEEP_FIELDS(ADJOINT, INDEX)                                                                         \
  ADJOINT(x_start)                                                                                                   \
  ADJOINT(x_prev)                                                                                                    \
  ADJOINT(y) ADJOINT(mu) ADJOINT(lam) ADJOINT(mass) ADJOINT(rest) ADJOINT(energy_data) INDEX(origin) ADJOINT(bounds) \
      ADJOINT(collider) ADJOINT(collider_prev) ADJOINT(kappa) INDEX(pairs) INDEX(constants) INDEX(ptr) INDEX(entry)  \
          ADJOINT(lag) INDEX(lag_pairs) INDEX(lag_ptr) INDEX(lag_entry) ADJOINT(floor_lag)

// A whole step in one operator (CUDA).
#define DIFFVBD_STEP_FIELDS(ADJOINT, INDEX) \
  ADJOINT(x) ADJOINT(v) ADJOINT(acceleration) ADJOINT(prescribed) ADJOINT(mu) ADJOINT(lam) ADJOINT(mass) ADJOINT(rest)

// The rigid correction (rigid/body.h): order, ptr: vertices of the bodies that are corrected; spread: their squared
// radius of gyration [m^2]; other [vertices]: -2 for what is listed.
#define DIFFVBD_RIGID_FIELDS(ADJOINT, INDEX)                                                                        \
  ADJOINT(x)                                                                                                        \
  ADJOINT(x_prev) ADJOINT(y) ADJOINT(mass) ADJOINT(energy_data) INDEX(origin) INDEX(order) INDEX(ptr) INDEX(spread) \
      INDEX(other)

// The beginning of a step (start/begin.h): as of the correction, and the other bodies. other [vertices]: which of them
// a vertex is in, -1: none, -2: it is corrected; other_tets [listed, 5]: a tet and its corners; rest [1 | scenes, tets,
// kRestScalars], empty where tets have no energy.
#define DIFFVBD_BEGIN_FIELDS(ADJOINT, INDEX)                                                                      \
  ADJOINT(x)                                                                                                      \
  ADJOINT(v) ADJOINT(acceleration) ADJOINT(prescribed) ADJOINT(mass) ADJOINT(energy_data) INDEX(origin) INDEX(mu) \
      INDEX(lam) INDEX(rest) INDEX(pinned) INDEX(order) INDEX(ptr) INDEX(spread) INDEX(other) INDEX(other_order)  \
          INDEX(other_ptr) INDEX(other_tets) INDEX(other_tet_ptr)

namespace diffvbd {

#define DIFFVBD_TENSOR(name) torch::stable::Tensor name;
#define DIFFVBD_NEXT(name) given[at++],
#define DIFFVBD_ONE(name) +1

// A list by the names of its fields.
#define DIFFVBD_STRUCT(Name, FIELDS)                                                                               \
  struct Name {                                                                                                    \
    FIELDS(DIFFVBD_TENSOR, DIFFVBD_TENSOR)                                                                         \
    static Name of(const std::vector<torch::stable::Tensor>& given) {                                              \
      constexpr size_t expected = 0 FIELDS(DIFFVBD_ONE, DIFFVBD_ONE);                                              \
      if (given.size() != expected) throw std::invalid_argument("diffvbd: a list of fields has the wrong length"); \
      size_t at = 0;                                                                                               \
      return Name{FIELDS(DIFFVBD_NEXT, DIFFVBD_NEXT)};                                                             \
    }                                                                                                              \
  };
DIFFVBD_STRUCT(SweepFields, DIFFVBD_SWEEP_FIELDS)
DIFFVBD_STRUCT(StepFields, DIFFVBD_STEP_FIELDS)
DIFFVBD_STRUCT(RigidFields, DIFFVBD_RIGID_FIELDS)
DIFFVBD_STRUCT(BeginFields, DIFFVBD_BEGIN_FIELDS)

// Adjoints of a list, in its order: empty where not wanted.
#define DIFFVBD_NONE(name)
#define DIFFVBD_ITEM(name) name,
#define DIFFVBD_BARS(Name, FIELDS)                                                                   \
  struct Name {                                                                                      \
    FIELDS(DIFFVBD_TENSOR, DIFFVBD_NONE)                                                             \
    std::vector<torch::stable::Tensor> list() const { return {FIELDS(DIFFVBD_ITEM, DIFFVBD_NONE)}; } \
  };
DIFFVBD_BARS(SweepBars, DIFFVBD_SWEEP_FIELDS)
DIFFVBD_BARS(StepBars, DIFFVBD_STEP_FIELDS)

#undef DIFFVBD_TENSOR
#undef DIFFVBD_NEXT
#undef DIFFVBD_ONE
#undef DIFFVBD_STRUCT
#undef DIFFVBD_NONE
#undef DIFFVBD_ITEM
#undef DIFFVBD_BARS

}  // namespace diffvbd
