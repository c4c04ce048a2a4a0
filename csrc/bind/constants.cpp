// Constants that Python needs as well: defaults of the parameters of an operator that nobody calls, which Python reads.
#include <string>

#include "../contact/detection.h"
#include "../contact/intersect.h"
#include "../contact/islands.h"
#include "../contact/limit.h"
#include "../contact/motion.h"
#include "../contact/pairs.h"
#include "../subspace/begin.h"
#include "../subspace/coarse.h"
#include "../subspace/contact_rigid.h"
#include "arguments.h"

#ifndef USE_CUDA

#define DIFFVBD_WORD(name) #name " "

STABLE_TORCH_LIBRARY_FRAGMENT(diffvbd, m) {
  using namespace diffvbd;
  std::string schema;
  const auto add = [&](const std::string& type, const char* name, const std::string& value) {
    schema += (schema.empty() ? "constants(" : ", ") + type + " " + name + "=" + value;
  };
  const std::pair<const char*, int64_t> numbers[] = {
      {"cpu_lanes", kLanes},  // vertices of a block of the plan
      {"cuda_lanes", kSlice},
      {"plan_header", kPlanHeader},
      {"row", kRow},  // scalars of a row of positions
      {"rest_scalars", kRestScalars},
      {"pair_rest", kPairRest},  // scalars of a rest shape that one vertex sees
      {"lag_scalars", contact::kLagScalars},
      {"plane_scalars", contact::kPlaneScalars},
      {"pair_row", contact::kPairRow},
      {"pair_constants", contact::kConstants},
      {"near_row", contact::kNearRow},
      {"near_values", contact::kNearValues},
      {"counts", contact::kCounts},
      {"crossing_row", contact::kCrossingRow},
      {"most_coupled", contact::kMostCoupled},  // bodies of a group of those that touch
      {"start_inertia", start::kInertia},
      {"start_predictor", start::kPredictor},
      {"start_lower", start::kLower},
      {"corrected", rigid::kCorrected},
      {"tile", coarse::kTile},        // unknowns of a body beyond which it counts as large
      {"no_move", contact::kNoMove},  // exponent of a limit of 0
      {"workspace_budget", kWorkspaceBudget},
      {"roundings", static_cast<int64_t>(kRounding)},  // ulps of the terms by which a potential may rise
  };
  for (const auto& [name, value] : numbers) add("int", name, std::to_string(value));
  add("str", "sweep_adjoints", "\"" DIFFVBD_SWEEP_FIELDS(DIFFVBD_WORD, DIFFVBD_NONE) "\"");
  add("str", "step_adjoints", "\"" DIFFVBD_STEP_FIELDS(DIFFVBD_WORD, DIFFVBD_NONE) "\"");
  add("str", "touching_adjoints", "\"" DIFFVBD_TOUCHING_FIELDS(DIFFVBD_WORD, DIFFVBD_NONE) "\"");
  m.def((schema + ") -> ()").c_str());
}

#endif
